//! The firmware: an RTIC application that makes an STM32F4 an LSS slave.

#![no_std]
#![no_main]

mod pins;

use defmt_rtt as _;
use panic_probe as _;

#[allow(unsafe_op_in_unsafe_fn, reason = "in RTIC's code")]
#[rtic::app(device = stm32f4xx_hal::pac)]
mod app {
    use canopen_stm32f4::{Board, Crystal, Indicators, Storage, Watchdog, board, watchdog::Task};
    use firmware::{
        application::{Application, Node},
        device::{self, DEVICE},
    };

    use crate::pins::{Can, Pins};

    type Runner = canopen_stm32f4::Runner<Can, Application>;

    const CRYSTAL: Crystal = Crystal::new(device::CRYSTAL_HZ, device::CRYSTAL_IS_EXTERNAL_CLOCK);

    #[shared]
    struct Shared {
        runner: Runner,
    }

    #[local]
    struct Local {
        indicators: Indicators,
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
        let pins = Pins::new(chip.GPIOA, chip.GPIOB, chip.GPIOC, chip.GPIOD, &mut board.rcc);
        let device = DEVICE.with_serial_number(board::serial_number());
        let (runner, storage, watchdog) =
            board.start(device, Application::new(), chip.CAN1, pins.can);
        (Shared { runner }, Local { indicators: pins.indicators, storage, watchdog })
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
    #[task(binds = CAN1_RX0, shared = [runner], priority = 3)]
    fn received(mut cx: received::Context) {
        cx.shared.runner.lock(Runner::handle_received);
    }

    /// Fills an empty mailbox with the next frame. If it runs late, another node's frame goes first.
    #[task(binds = CAN1_TX, shared = [runner], priority = 3)]
    fn transmitted(mut cx: transmitted::Context) {
        cx.shared.runner.lock(Runner::handle_transmitted);
    }

    /// Handles error passive and bus-off; the controller recovers from bus-off by itself.
    #[task(binds = CAN1_SCE, shared = [runner], priority = 3)]
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

    /// Writes to the flash, at a priority below all bus tasks. If it runs late, so is the answer to store
    /// configuration: 20 ms are allowed. The interrupt is that of the clocks, which nobody else needs.
    #[task(binds = RCC, local = [storage], shared = [runner], priority = 1)]
    fn store(mut cx: store::Context) {
        cx.local.storage.store(&mut cx.shared.runner);
    }
}
