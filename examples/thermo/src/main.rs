//! The firmware of the thermometer: the tasks of every product, and one that reads the sensors.

#![no_std]
#![no_main]

mod pins;
mod sensors;

use defmt_rtt as _;
use panic_probe as _;

#[allow(unsafe_op_in_unsafe_fn, reason = "in RTIC's code")]
#[rtic::app(device = stm32f4xx_hal::pac)]
mod app {
    use canopen_stm32f4::{Board, Crystal, Indicators, Storage, Watchdog, board, watchdog::Task};
    use example_thermo::{
        application::{Application, DEVICE_PROFILE, Node, SENSOR_FAULT},
        device::{self, DEVICE},
    };

    use crate::{
        pins::{Can, Pins, Ports, Relays},
        sensors::Sensors,
    };

    type Runner = canopen_stm32f4::Runner<Can, Application>;

    const CRYSTAL: Crystal = Crystal::new(device::CRYSTAL_HZ, device::CRYSTAL_IS_EXTERNAL_CLOCK);

    #[shared]
    struct Shared {
        runner: Runner,
    }

    #[local]
    struct Local {
        indicators: Indicators,
        sensors: Sensors,
        relays: Relays,
        storage: Storage<{ Node::STORED_LEN }>,
        watchdog: Watchdog,
    }

    #[init]
    fn init(cx: init::Context) -> (Shared, Local) {
        let chip = cx.device;
        let mut board = Board::new(
            board::Peripherals {
                clocks: chip.RCC,
                debug: chip.DBGMCU,
                flash: chip.FLASH,
                power: chip.PWR,
                timer: chip.TIM2,
                watchdog: chip.IWDG,
            },
            &cx.core,
            CRYSTAL,
        );
        let ports = Ports { a: chip.GPIOA, b: chip.GPIOB, c: chip.GPIOC, d: chip.GPIOD };
        let Pins { can, indicators, node_id_switches, sensors, relays } =
            Pins::new(ports, &mut board.rcc);
        let sensors = Sensors::new(sensors, chip.ADC1, chip.TIM5, &mut board.rcc);
        let mut device = DEVICE.with_serial_number(board::serial_number());
        if let Some(node_id) = board::node_id(&node_id_switches) {
            device = device.with_defaults(device.defaults.with_node_id(Some(node_id)));
        }
        let (runner, storage, watchdog) = board.start(device, Application::new(), chip.CAN2, can);
        (Shared { runner }, Local { indicators, sensors, relays, storage, watchdog })
    }

    /// Sleeps; the debugger can still read the log.
    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            Task::IDLE.answer();
            cortex_m::asm::wfi();
        }
    }

    /// Handles received frames and sends the answer. If it runs late by more than three frames (150 us at 1 Mbit/s),
    /// frames are lost.
    #[task(binds = CAN2_RX0, shared = [runner], priority = 3)]
    fn received(mut cx: received::Context) {
        cx.shared.runner.lock(Runner::handle_received);
    }

    /// Fills an empty mailbox with the next frame. If it runs late, another node's frame goes first.
    #[task(binds = CAN2_TX, shared = [runner], priority = 3)]
    fn transmitted(mut cx: transmitted::Context) {
        cx.shared.runner.lock(Runner::handle_transmitted);
    }

    /// Handles error passive and bus-off; the controller recovers from bus-off by itself.
    #[task(binds = CAN2_SCE, shared = [runner], priority = 3)]
    fn status(mut cx: status::Context) {
        cx.shared.runner.lock(Runner::handle_status);
    }

    /// Does what is due: ends of switch delays, heartbeats, steps of the indicators, and the roll call that feeds the
    /// watchdog. If it runs late, the bit rate switches late.
    #[task(binds = TIM2, local = [indicators, watchdog], shared = [runner], priority = 3)]
    fn due(mut cx: due::Context) {
        let Some(lit) = cx.shared.runner.lock(Runner::handle_alarm) else {
            return;
        };
        cx.local.indicators.light(lit);
        cx.local.watchdog.step();
    }

    /// Reads the sensors ten times a second, and sets the relays.
    #[task(binds = TIM5, local = [sensors, relays], shared = [runner], priority = 2)]
    fn sample(mut cx: sample::Context) {
        let millivolts = cx.local.sensors.read();
        let relays = cx.shared.runner.lock(|runner| {
            runner.with(|node| {
                let step = node.application_mut().step(millivolts);
                for sensor in 0..4 {
                    match (step.new_faults >> sensor & 1, step.ended_faults >> sensor & 1) {
                        // There is room for eight errors.
                        (1, _) => _ = node.report(SENSOR_FAULT + sensor, DEVICE_PROFILE, [0; 5]),
                        (_, 1) => node.end_report(SENSOR_FAULT + sensor),
                        _ => {}
                    }
                }
                step.relays
            })
        });
        cx.local.relays.set(relays);
    }

    /// Writes to the flash, at a priority below all bus tasks. If it runs late, so is the answer to store
    /// configuration: 20 ms are allowed. The interrupt is that of the clocks, which nobody else needs.
    #[task(binds = RCC, local = [storage], shared = [runner], priority = 1)]
    fn store(mut cx: store::Context) {
        cx.local.storage.store(&mut cx.shared.runner);
    }
}
