//! `cargo xtask chips`: the image of every chip, built and run on its emulated board.

mod choices;
mod leds;

use std::{fmt, time::Instant};

use anyhow::{Context, bail, ensure};
use canopen_node::{BitRate, NodeId, Settings, bit_rate::BitTiming};
use canopen_stm32f4::chip::{self, Chip};
use emulator::{
    Time, board,
    can::{Adapter, BitSegments, Clock, Frame, Id},
    chip::{ChipVariant, Part},
    image::Image,
    network::{Network, What},
};
use lss_master::Fastscan;
use testkit::{
    boards,
    boards::Variant,
    frames, image,
    image_rig::ImageRig,
    parallel, product,
    sessions::{self, AWAY, Session},
    settings::Stored,
    wire::{bit_per_s, on_the_wire},
};

/// Build the image of every chip, and run it on its emulated board; CAN2 and CAN3 on one chip each
///
/// For each chip the table shows the clock of the core, the flash that the image takes, the time from power-on to the
/// boot-up, whether all eight bit rates are exact and work with crystals that are 0.5 % off at both ends, and the
/// outcome of the sessions: a blank board is found by Fastscan, gets a node-ID and a bit rate, stores, switches, loses
/// its power and boots up with what was stored; then those of `cargo verify chip-variants --quick`, and a start by a
/// boot loader that leaves the PLL, interrupts and its vector table on. A wrong choice of
/// chips, controller or pins must not build, and the boards of `cargo flash --board` blink.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Only this chip
    #[arg(long)]
    chip: Option<Part>,
}

/// The results of one chip.
struct Row {
    core_mhz: u32,
    boot: Time,
    rates: anyhow::Result<()>,
    sessions: anyhow::Result<()>,
}

/// A chip and the number of its CAN controller, 1 for CAN1.
#[derive(Clone, Copy)]
struct Target {
    part: Part,
    controller: u8,
}

/// CAN1 of every chip, and once each CAN2 with the RX and TX pins of most chips, CAN2 and CAN3 of a chip with 100 MHz.
fn targets(only: Option<Part>) -> Vec<Target> {
    let others = [(Part::Stm32f446, 2), (Part::Stm32f413, 2), (Part::Stm32f413, 3)];
    let all = Part::F4.map(|part| (part, 1)).into_iter().chain(others);
    all.filter(|(part, _)| only.is_none_or(|only| only == *part))
        .map(|(part, controller)| Target { part, controller })
        .collect()
}

impl Target {
    /// The image: on CAN1 the plain firmware, otherwise a new product.
    fn image(&self) -> anyhow::Result<Image> {
        let Self { part, controller } = *self;
        Ok(if controller == 1 { image::build(part)? } else { product::build(part, controller)? })
    }
}

impl fmt::Display for Target {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`", self.part.name())?;
        if self.controller > 1 { write!(f, ", CAN{}", self.controller) } else { Ok(()) }
    }
}

/// Prints the table. Fails if a chip fails, or a wrong choice of chips, controller or pins builds.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let begin = Instant::now();
    let targets = targets(arguments.chip);
    let images = targets.iter().map(Target::image).collect::<Result<Vec<_>, _>>()?;
    let built = begin.elapsed().as_secs();

    println!("| chip | manual | core | flash | boot-up | all rates exact | sessions |");
    println!("|---|---|---|---|---|---|---|");
    let boards: Vec<_> = targets.iter().zip(&images).collect();
    let mut rows = Vec::new();
    let run = |&(&target, image): &(&Target, &Image)| row(target, image);
    parallel::map(&boards, run, |at, row| rows.push((at, row)));
    rows.sort_by_key(|(at, _)| *at);
    let mut failures = Vec::new();
    for (at, row) in rows {
        let (target, image) = boards[at];
        let bytes: usize = image.segments().map(|(_, bytes)| bytes.len()).sum();
        print!("| {target} | {} | ", target.part.manual());
        match row {
            Ok(Row { core_mhz, boot, rates, sessions }) => {
                let outcome =
                    |result: &anyhow::Result<()>| if result.is_ok() { "yes" } else { "NO" };
                let ms = boot.as_ps() as f64 / 1e9;
                let (exact, passed) = (outcome(&rates), outcome(&sessions));
                println!("{core_mhz} MHz | {bytes} | {ms:.1} ms | {exact} | {passed} |");
                failures.extend(
                    [rates, sessions].into_iter().filter_map(Result::err).map(|e| (target, e)),
                );
            }
            Err(error) => {
                println!("- | {bytes} | NO | - | - |");
                failures.push((target, error));
            }
        }
    }
    for (target, error) in &failures {
        println!("{target}: {error:#}");
    }
    choices::check()?;
    leds::check()?;
    let seconds = begin.elapsed().as_secs();
    println!(
        "\n{} images, {} failures; legal pins build, wrong chips, controllers and pins do not; {seconds} s, {built} of \
         them to build the images",
        targets.len(),
        failures.len()
    );
    ensure!(failures.is_empty(), "the image does not work on every chip");
    Ok(())
}

fn row(Target { part, controller }: Target, image: &Image) -> anyhow::Result<Row> {
    let settings = board::Settings { controller: controller.into(), ..Default::default() };
    let variant = Variant { image, part, settings };
    let (core_mhz, boot) = sessions::outcome(|| boot(&variant))?;
    let chip_variant = ChipVariant { boot_loader: true, ..ChipVariant::default() };
    let after_loader =
        Variant { settings: board::Settings { chip_variant, ..settings }, ..variant };
    let mut all: Vec<(&str, &Variant, Session)> = vec![
        ("commissioning", &variant, commission),
        ("a boot loader starts the program", &after_loader, |variant| _ = self::boot(variant)),
    ];
    all.extend(sessions::all(true).into_iter().map(|(name, session)| (name, &variant, session)));
    let sessions = all.into_iter().try_for_each(|(name, variant, session)| {
        sessions::outcome(|| session(variant)).context(name)
    });
    Ok(Row { core_mhz, boot, rates: check_rates(&variant), sessions })
}

fn stored(bit_rate: BitRate) -> Stored {
    Settings::new(bit_rate.into()).with_node_id(NodeId::new(5)).into()
}

/// The clock of the core in MHz, and the time from power-on to the end of the boot-up at 1 Mbit/s.
fn boot(variant: &Variant) -> (u32, Time) {
    let board = variant.board(0, Some(stored(BitRate::Kbit1000)));
    let mut rig = ImageRig::new(BitRate::Kbit1000, [board]);
    let boot = rig.expect("705: 00", AWAY);
    let clocks = rig.network.board(0).chip().clocks();
    let chip = Chip::named(variant.part.name()).expect("boards/stm32f4/src/chip.rs has this chip");
    assert_eq!(clocks.hclk.hz, chip::sysclk_hz(&chip), "the clock of the core");
    assert_eq!(clocks.pclk1.hz, chip::APB1_HZ, "the clock of APB1");
    (clocks.hclk.hz / 1_000_000, boot)
}

/// The board sets each rate exactly, with a bit timing that tolerates 0.5 % at both ends, and answers a master with
/// such a difference without an error.
fn check_rates(variant: &Variant) -> anyhow::Result<()> {
    for rate in BitRate::ALL {
        for ppm in [0, 5_000, -5_000] {
            check_rate(variant, rate, ppm)
                .with_context(|| format!("{} kbit/s at {ppm} ppm", rate.kbit_per_s()))?;
        }
    }
    Ok(())
}

fn check_rate(variant: &Variant, rate: BitRate, ppm: i32) -> anyhow::Result<()> {
    let crystal = Clock { ppm, ..variant.settings.crystal };
    let settings = board::Settings { crystal, ..variant.settings };
    let board = Variant { settings, ..*variant }.board(0, Some(stored(rate)));
    let mut network = Network::new();
    network.add_board(board);
    let timing = BitTiming::solve(rate, chip::APB1_HZ).context("no bit timing")?;
    let master = network.add_adapter(Adapter::with_timing(
        Clock { hz: chip::APB1_HZ, ppm: -ppm },
        BitSegments {
            prescaler: timing.prescaler,
            segment_1: timing.segment1.into(),
            segment_2: timing.segment2,
            jump_width: timing.sync_jump_width,
        },
    ));
    let expect = |network: &mut Network, expected: &str| -> anyhow::Result<()> {
        let frame = network.run_until_received(master, Time::from_s(1));
        let (_, frame) = frame.with_context(|| format!("{expected} is not received"))?;
        ensure!(frame == on_the_wire(&frames::of_node(expected)), "{frame}, not {expected}");
        Ok(())
    };
    expect(&mut network, "705: 00")?;
    // The longest runs of equal bits, which nobody answers.
    for data in [[0x00; 8], [0xFF; 8], [0x0F; 8]] {
        network.send(master, Frame::data(Id::Standard(0x400), &data));
    }
    network.send(master, on_the_wire(&frames::of_master("04 01")));
    network.send(master, on_the_wire(&frames::of_master("5E")));
    expect(&mut network, "5E 05")?;

    let written = network.trace().iter().rev().find_map(|event| match event.what {
        What::BitTiming { btr, .. } => Some(btr),
        _ => None,
    });
    let btr = written.context("no bit timing is set")?;
    let timing = BitTiming {
        prescaler: (btr & 0x3FF) as u16 + 1,
        segment1: (btr >> 16 & 0xF) as u8 + 1,
        segment2: (btr >> 20 & 7) as u8 + 1,
        sync_jump_width: (btr >> 24 & 3) as u8 + 1,
    };
    let apb1_hz = network.board(0).chip().clocks().pclk1.hz;
    let periods = u32::from(timing.prescaler) * timing.quanta();
    ensure!(periods * bit_per_s(rate) == apb1_hz, "CAN_BTR is {btr:08X} at {apb1_hz} Hz");
    let tolerance = timing.crystal_tolerance_ppm();
    ensure!(
        tolerance >= BitTiming::CRYSTAL_ERROR_PPM,
        "CAN_BTR {btr:08X} tolerates {tolerance} ppm"
    );
    if let Some(event) =
        network.trace().iter().find(|event| matches!(event.what, What::Error { .. }))
    {
        bail!("{event}");
    }
    let findings = network.board(0).findings();
    ensure!(findings.is_empty(), "{}", findings[0]);
    Ok(())
}

/// A blank board is found, gets a node-ID and a rate, stores, switches, loses its power and boots up with both.
fn commission(variant: &Variant) {
    let mut rig = ImageRig::new(BitRate::Kbit125, [variant.board(0, None)]);
    rig.reach("4C", "50", AWAY);
    let found = rig.carry_out(Fastscan::new()).expect("the board is found");
    assert_eq!(found.serial_number, boards::serial_number(0));
    for (request, answer) in [("11 05", "11 00"), ("13 00 00", "13 00"), ("17", "17 00")] {
        rig.ask(request, answer);
    }
    rig.send("15 32 00");
    rig.network.run_for(Time::from_ms(55));
    rig.set_master_bit_rate(BitRate::Kbit1000);
    rig.network.run_for(Time::from_ms(55));
    rig.send("04 00");
    rig.expect("705: 00", AWAY);
    rig.power_cycle(0);
    rig.expect("705: 00", AWAY);
    rig.expect("705: 7F", AWAY);
}
