//! Calls all of the runner, over a board of which nothing is known.

use core::hint::black_box;

use canopen_node::{
    BitRate, Frame, Instant, Node, Numbers, Receives, Service, Services,
    indicator::BusState,
    lss::StoreError,
    runner::{BusError, Controller, Mode, Received, Runner, Sample, System},
    settings::Log,
};

use crate::{Flash, Objects, ObjectsNode, any, any_device, any_instant, any_settings};

/// Calls a runner, which between the calls is in any state that its types allow.
pub fn drive() {
    let node: ObjectsNode =
        Node::with_application(any_device(), any(Some(any_settings())), any(Objects::new()));
    let mut runner = Runner::new(node, Board, Board);
    let runner = black_box(&mut runner);
    runner.handle_received();
    runner.handle_transmitted();
    runner.handle_status();
    black_box(runner.handle_alarm());
    let mut log = Log::<_, { ObjectsNode::STORED_LEN }>::open_with_parameters(Flash).0;
    _ = black_box(runner.poll(black_box(&mut log)));
    black_box(runner.take_store(any(&[]), any(&mut [])));
    runner.handle_stored(any(Err(StoreError::MediumAccess)));
    runner.application(|objects| _ = black_box(objects));
    runner.with(|node| node.report(any(0), any(0), any([0; 5])));
    runner.with(|node| node.end_report(any(0)));
    runner.with(|node| node.send_tpdo(any(0)));
}

struct Board;

impl Controller for Board {
    fn start<N: Numbers>(
        &mut self,
        mode: Mode,
        bit_rate: BitRate,
        receives: &Receives<N>,
    ) -> bool {
        black_box((mode, bit_rate, receives));
        any(true)
    }

    fn receive(&mut self) -> Option<Received> {
        any(None)
    }

    fn send(&mut self, frame: &Frame, service: Service) -> bool {
        black_box((frame, service));
        any(true)
    }

    fn take_sent(&mut self) -> Services {
        any(Services::NONE)
    }

    fn is_idle(&mut self) -> bool {
        any(true)
    }

    fn drop_frames(&mut self, services: Services) {
        black_box(services);
    }

    fn take_error(&mut self) -> Option<BusError> {
        any(None)
    }

    fn error_counters(&self) -> (u8, u8) {
        any((0, 0))
    }

    fn bus_state(&self) -> BusState {
        any(BusState::Good)
    }

    fn sample(&self) -> Option<Sample> {
        any(None)
    }
}

impl System for Board {
    fn now(&self) -> Instant {
        any_instant()
    }

    fn reset(&mut self) {}
}
