//! The firmware: an RTIC application that puts the LSS slave on an STM32F4.

#![no_std]
#![no_main]

mod board;
mod can;
mod clock;
mod device;
mod fault;
mod flash;
mod roll_call;
mod slave;
mod transmit_queue;

use defmt_rtt as _;
use panic_probe as _;

const _: () = assert!(
    cfg!(feature = "stm32f405") as u8
        + cfg!(feature = "stm32f407") as u8
        + cfg!(feature = "stm32f427") as u8
        + cfg!(feature = "stm32f446") as u8
        == 1,
    "choose one chip: --features stm32f405, stm32f407, stm32f427 or stm32f446"
);

#[rtic::app(device = stm32f4xx_hal::pac, dispatchers = [USART1, USART2, USART3])]
mod app {
    use lss_slave::{
        Node, NodeId, Settings,
        emergency::Fault,
        indicator,
        settings::{Failure, Found, Log},
    };
    use rtic_monotonics::systick::prelude::*;
    use rtic_sync::{
        make_signal,
        signal::{SignalReader, SignalWriter},
    };
    use stm32f4xx_hal::{
        gpio::{ErasedPin, Output},
        pac::Interrupt,
        watchdog::IndependentWatchdog,
    };

    use crate::{
        board::{self, Board},
        can::Controller,
        clock::{self, Mono},
        device,
        flash::SettingsFlash,
        roll_call::{self, Task},
        slave::Slave,
    };

    #[shared]
    struct Shared {
        slave: Slave,
    }

    #[local]
    struct Local {
        log: Log<SettingsFlash>,
        indicators: (ErasedPin<Output>, ErasedPin<Output>),
        watchdog: IndependentWatchdog,
        roll_call: SignalWriter<'static, ()>,
    }

    #[init]
    fn init(cx: init::Context) -> (Shared, Local) {
        let mut board = Board::new(cx.device);
        clock::start(cx.core.SYST);

        let (log, found) = Log::open(board.settings_flash);
        let settings = log.settings().unwrap_or(device::DEFAULTS);
        report(found, log.failure(), &settings);

        let node = Node::new(board::device(), settings);
        let can = Controller::new(board.can, board.can_pins, &mut board.rcc, node.receives());
        let (deadline_changed, changed) = make_signal!(());
        let roll_call = deadline_changed.clone();
        let (store, requests) = make_signal!(Settings);
        let mut slave = Slave::new(node, can, store, deadline_changed);
        if found == Found::Damaged {
            slave.handle_fault(Fault::SettingsLost);
        }

        // Each task is spawned once, and so its place is free.
        let _ = deadlines::spawn(changed);
        let _ = store::spawn(requests);
        let _ = watch::spawn();
        let _ = indicate::spawn();
        let Board { indicators, watchdog, .. } = board;
        (Shared { slave }, Local { log, indicators, watchdog, roll_call })
    }

    /// Sleeps. The debugger reads the log all the same.
    #[idle]
    fn idle(_: idle::Context) -> ! {
        loop {
            roll_call::answer(Task::Idle);
            cortex_m::asm::wfi();
        }
    }

    /// A frame has been received: the answer leaves from here. Late by more than three frames (150 us at 1 Mbit/s), frames
    /// are lost.
    #[task(binds = CAN1_RX0, shared = [slave], priority = 3)]
    fn received(mut cx: received::Context) {
        roll_call::answer(Task::Received);
        cx.shared.slave.lock(Slave::handle_received);
    }

    /// A mailbox is empty: the next frame goes there. Late, another node's frame goes first.
    #[task(binds = CAN1_TX, shared = [slave], priority = 3)]
    fn transmitted(mut cx: transmitted::Context) {
        roll_call::answer(Task::Transmitted);
        cx.shared.slave.lock(Slave::handle_transmitted);
    }

    /// The controller has become error passive or bus-off; from the latter it recovers by itself.
    #[task(binds = CAN1_SCE, shared = [slave], priority = 3)]
    fn status(mut cx: status::Context) {
        roll_call::answer(Task::Status);
        cx.shared.slave.lock(Slave::handle_status);
    }

    /// Does what is due at a time: ends of switch delays, heartbeats. Late, the bit rate switches late: within 1 ms.
    #[task(shared = [slave], priority = 3)]
    async fn deadlines(mut cx: deadlines::Context, mut changed: SignalReader<'static, ()>) {
        loop {
            roll_call::answer(Task::Deadlines);
            let deadline = cx.shared.slave.lock(Slave::handle_deadline);
            clock::wait(changed.wait(), deadline).await;
        }
    }

    /// Writes to the flash, below everything on the bus. Late, so is the answer to store configuration: 20 ms are allowed.
    #[task(local = [log], shared = [slave], priority = 1)]
    async fn store(mut cx: store::Context, mut requests: SignalReader<'static, Settings>) {
        loop {
            let outcome = cx.local.log.store(requests.wait().await);
            match cx.local.log.failure() {
                None => defmt::info!("settings stored"),
                Some(failure) => defmt::error!(
                    "the settings are not stored, the old ones are kept: {=istr}",
                    why(failure)
                ),
            }
            cx.shared.slave.lock(|slave| slave.handle_stored(outcome));
        }
    }

    /// Shows the state of the node. Late, it flickers unevenly.
    #[task(local = [indicators], shared = [slave], priority = 1)]
    async fn indicate(mut cx: indicate::Context) {
        let (run, error) = cx.local.indicators;
        let mut next = Mono::now();
        loop {
            let lit = cx.shared.slave.lock(Slave::indicate);
            run.set_state(lit.run.into());
            error.set_state(lit.error.into());
            next += u64::from(indicator::STEP_MS).millis();
            Mono::delay_until(next).await;
        }
    }

    /// Calls the roll four times a second and feeds the watchdog if everyone has answered; it bites after 2 s.
    #[task(local = [watchdog, roll_call], shared = [slave], priority = 2)]
    async fn watch(mut cx: watch::Context) {
        loop {
            if roll_call::is_everyone_present() {
                cx.local.watchdog.feed();
            }
            for interrupt in [Interrupt::CAN1_RX0, Interrupt::CAN1_TX, Interrupt::CAN1_SCE] {
                rtic::pend(interrupt);
            }
            cx.local.roll_call.write(());
            cx.shared.slave.lock(Slave::supervise);
            Mono::delay(250.millis()).await;
        }
    }

    fn report(found: Found, failure: Option<Failure>, settings: &Settings) {
        match found {
            Found::Complete => {}
            Found::Interrupted => {
                defmt::warn!("the last store was interrupted; using the one before")
            }
            Found::Blank => defmt::info!("no settings stored yet; using the defaults"),
            Found::Damaged => {
                defmt::error!("the settings in flash are damaged; using the defaults")
            }
            Found::MediumFailed => defmt::error!("the flash fails; nothing can be stored"),
        }
        if let Some(failure) = failure {
            defmt::error!("the flash could not be made ready: {=istr}", why(failure));
        }
        defmt::info!(
            "node-ID {=u8:#x}, bit timing table index {=u8}",
            NodeId::to_lss(settings.node_id),
            settings.bit_rate.index()
        );
    }

    fn why(failure: Failure) -> defmt::Str {
        match failure {
            Failure::Refused => defmt::intern!("the flash reports an error"),
            Failure::NotBlank => defmt::intern!("the flash is not blank where it was erased"),
            Failure::NotAsWritten => defmt::intern!("the flash reads back otherwise than written"),
            Failure::Full => defmt::intern!("the flash is full until the next power-on"),
        }
    }
}
