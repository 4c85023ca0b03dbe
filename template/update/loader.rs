//! The loader: an RTIC application in RAM that replaces the program over the bus.

#![no_std]
#![no_main]

mod pins;

canopen_stm32f4::loader!();

#[allow(unsafe_op_in_unsafe_fn, reason = "in RTIC's code")]
#[rtic::app(device = stm32f4xx_hal::pac)]
mod app {
    use canopen_stm32f4::{
        Board, Crystal, Indicators, Watchdog, board,
        update::loader::{self, Place, Work},
    };
    use firmware::device::{self, DEVICE};

    use crate::pins::{Can, Pins};

    type Runner = loader::Runner<Can>;

    const CRYSTAL: Crystal = Crystal::new(device::CRYSTAL_HZ, device::CRYSTAL_IS_EXTERNAL_CLOCK);

    #[shared]
    struct Shared {
        runner: Runner,
    }

    #[local]
    struct Local {
        indicators: Indicators,
        watchdog: Watchdog,
        work: Work,
    }

    /// Starts the program, unless there is something to do here.
    #[init(local = [place: Place = Place::uninit()])]
    fn init(cx: init::Context) -> (Shared, Local) {
        // SAFETY: it is the first act, and nothing has a peripheral yet.
        let stay = unsafe { loader::start_or_stay(&cx.core) };
        let chip = cx.device;
        let mut board = Board::of_loader(
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
            &stay,
        );
        let pins = Pins::new(chip.GPIOB, chip.GPIOD, &mut board.rcc);
        let device = DEVICE.with_serial_number(board::serial_number());
        let (runner, work, watchdog) =
            board.start_loader(device, cx.local.place, stay, chip.CAN1, pins.can);
        (Shared { runner }, Local { indicators: pins.indicators, watchdog, work })
    }

    /// Clears, programs and restores, step by step, and sleeps in between.
    #[idle(local = [work], shared = [runner])]
    fn idle(mut cx: idle::Context) -> ! {
        loop {
            cx.local.work.step(&mut cx.shared.runner);
        }
    }

    /// Handles received frames and sends the answer.
    #[task(binds = CAN1_RX0, shared = [runner], priority = 3)]
    fn received(mut cx: received::Context) {
        cx.shared.runner.lock(Runner::handle_received);
    }

    /// Fills an empty mailbox with the next frame.
    #[task(binds = CAN1_TX, shared = [runner], priority = 3)]
    fn transmitted(mut cx: transmitted::Context) {
        cx.shared.runner.lock(Runner::handle_transmitted);
    }

    /// Handles error passive and bus-off.
    #[task(binds = CAN1_SCE, shared = [runner], priority = 3)]
    fn status(mut cx: status::Context) {
        cx.shared.runner.lock(Runner::handle_status);
    }

    /// Does what is due, and feeds the watchdog if all tasks answer.
    #[task(binds = TIM2, local = [indicators, watchdog], shared = [runner], priority = 3)]
    fn due(mut cx: due::Context) {
        let Some(lit) = cx.shared.runner.lock(Runner::handle_alarm) else {
            return;
        };
        cx.local.indicators.light(lit);
        cx.local.watchdog.step();
    }
}
