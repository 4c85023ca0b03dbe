//! The firmware: an RTIC application that makes an STM32F4 an LSS slave.

#![no_std]
#![no_main]

mod bit_timing;
mod board;
mod can;
mod can_pins;
mod clock;
mod controller;
mod crystal;
mod fault;
mod flash;
#[cfg(feature = "io")]
mod io_board;
mod led;
mod pins;
mod report;
mod roll_call;
mod runner;
mod start;
mod supply;
mod transmit_queue;

use defmt_rtt as _;
// The drivers take from `product` what is the product's own, so that any product can have them.
use lss_slave_firmware as product;
use panic_probe as _;

/// The application, with the interrupts of the CAN controller: RTIC does not accept `cfg_attr` for them.
macro_rules! application {
    ($received:ident, $transmitted:ident, $status:ident) => {
        #[allow(unsafe_op_in_unsafe_fn, reason = "in a macro RTIC's code counts as ours")]
        #[rtic::app(device = stm32f4xx_hal::pac)]
        mod app {
            use lss_slave::{
                emergency::Fault,
                indicator,
                lss::StoreError,
                settings::{Found, Log},
            };
            use lss_slave_firmware::{Application, Node, describe};
            use stm32f4xx_hal::pac::Interrupt;

            use crate::{
                board::{self, Board, IoBoard, Watchdog},
                can::Controller,
                fault,
                flash::SettingsFlash,
                led::Led,
                report::report,
                roll_call::{self, Task},
                runner::{PARAMETERS, Runner},
                start,
            };

            #[shared]
            struct Shared {
                runner: Runner,
            }

            #[local]
            struct Local {
                log: Log<SettingsFlash, PARAMETERS>,
                indicators: (Led, Led),
                watchdog: Watchdog,
                io: IoBoard,
            }

            #[init]
            fn init(cx: init::Context) -> (Shared, Local) {
                start::restore(&cx.core, &cx.device.RCC, &cx.device.FLASH);
                fault::guard_stack(&cx.core.MPU);
                let mut board = Board::new(cx.device);

                let (mut log, mut found) = Log::open_with_parameters(board.settings_flash);
                let stored = log.settings();
                let device = describe(board::serial_number()).with_defaults(board.defaults);
                let mut node = Node::with_application(device, stored, Application::new());
                if let Err(error) = log.restore(|parameter| node.restore(parameter)) {
                    found = Found::MediumFailed(error);
                }
                report(found, &stored.unwrap_or(device.defaults));
                if matches!(found, Found::Damaged | Found::ParametersDamaged) {
                    node.handle_fault(Fault::SettingsLost);
                }

                let can = Controller::new(board.can, board.can_pins, &mut board.rcc, node.receives());
                let Board { alarm, indicators, mut watchdog, io, .. } = board;
                // The start may have erased a sector, so the first roll call comes later.
                watchdog.feed();
                let runner = Runner::new(node, can, alarm);
                (Shared { runner }, Local { log, indicators, watchdog, io })
            }

            /// Sleeps; the debugger can still read the log.
            #[idle]
            fn idle(_: idle::Context) -> ! {
                loop {
                    roll_call::answer(Task::Idle);
                    cortex_m::asm::wfi();
                }
            }

            /// Handles received frames and sends the answer. If it runs late by more than three frames (150 us at
            /// 1 Mbit/s), frames are lost.
            #[task(binds = $received, shared = [runner], priority = 3)]
            fn received(mut cx: received::Context) {
                cx.shared.runner.lock(Runner::handle_received);
                roll_call::answer(Task::Received);
            }

            /// Fills an empty mailbox with the next frame. If it runs late, another node's frame goes first.
            #[task(binds = $transmitted, shared = [runner], priority = 3)]
            fn transmitted(mut cx: transmitted::Context) {
                cx.shared.runner.lock(Runner::handle_transmitted);
                roll_call::answer(Task::Transmitted);
            }

            /// Handles error passive and bus-off; the controller recovers from bus-off by itself.
            #[task(binds = $status, shared = [runner], priority = 3)]
            fn status(mut cx: status::Context) {
                roll_call::answer(Task::Status);
                cx.shared.runner.lock(Runner::handle_status);
            }

            /// Does what is due: ends of switch delays, heartbeats, steps of the indicators. If it runs late, the bit
            /// rate switches late.
            ///
            /// Starts a roll call four times a second, and feeds the watchdog if all tasks have answered. The watchdog
            /// resets the chip after 1.4 to 3.8 s, depending on its oscillator.
            #[task(binds = TIM2, local = [indicators, watchdog, steps: u8 = 0], shared = [runner], priority = 3)]
            fn due(mut cx: due::Context) {
                const ROLL_CALL_STEPS: u8 = 250 / indicator::STEP_MS as u8;
                let Some(lit) = cx.shared.runner.lock(Runner::handle_alarm) else {
                    return;
                };
                let (run, error) = cx.local.indicators;
                run.light(lit.run);
                error.light(lit.error);
                *cx.local.steps = cx.local.steps.wrapping_add(1) % ROLL_CALL_STEPS;
                if *cx.local.steps == 0 {
                    if roll_call::is_everyone_present() {
                        cx.local.watchdog.feed();
                    }
                    roll_call::begin([
                        Interrupt::$received,
                        Interrupt::$transmitted,
                        Interrupt::$status,
                        Interrupt::USART1,
                    ]);
                    cx.shared.runner.lock(Runner::supervise);
                }
            }

            /// Samples the inputs of the example `io` and lights its LEDs.
            #[cfg(feature = "io")]
            #[task(binds = TIM5, local = [io], shared = [runner], priority = 2)]
            fn sample(mut cx: sample::Context) {
                let sample = cx.local.io.sample();
                let filter = &mut cx.local.io.filter;
                let outputs =
                    cx.shared.runner.lock(|runner| runner.application(|io| io.step(sample, filter)));
                cx.local.io.light(outputs);
            }

            /// Writes to the flash, at a priority below all bus tasks. If it runs late, so is the answer to store
            /// configuration: 20 ms are allowed. The [`Runner`] pends the interrupt, which belongs to an unused USART.
            #[task(binds = USART1, local = [log], shared = [runner], priority = 1)]
            fn store(mut cx: store::Context) {
                roll_call::answer(Task::Store);
                let log = cx.local.log;
                let mut parameters = [0; PARAMETERS];
                let Some((settings, len)) =
                    cx.shared.runner.lock(|runner| runner.take_store(log.parameters(), &mut parameters))
                else {
                    return;
                };
                let parameters = parameters.get(..len).unwrap_or_default();
                let outcome = log.store_with_parameters(settings, parameters);
                cx.shared.runner.lock(|runner| runner.handle_stored(outcome.map_err(StoreError::from)));
                match outcome {
                    Ok(()) => defmt::info!("settings stored"),
                    Err(error) => {
                        defmt::error!("the settings were not stored, the old ones stay: {}", error);
                    }
                }
            }
        }
    };
}

#[cfg(not(any(feature = "can2", feature = "can3")))]
application!(CAN1_RX0, CAN1_TX, CAN1_SCE);
#[cfg(feature = "can2")]
application!(CAN2_RX0, CAN2_TX, CAN2_SCE);
#[cfg(feature = "can3")]
application!(CAN3_RX0, CAN3_TX, CAN3_SCE);
