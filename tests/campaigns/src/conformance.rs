//! `cargo verify conformance`: the cases of a conformance test, against release images on the emulated bus.

use std::{
    fs,
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use ::conformance::{
    APPLICATION_LAYER, Bench, Group, Lab, Line, OWN, Report,
    eds::Eds,
    lss::{LSS, Target},
};
use anyhow::{Context, ensure};
use can_bus::{
    adapter::{self, Mode, Received},
    stop::Stop,
};
use canopen_node::{BitRate, Frame, NodeId, Settings, lss::Address, nmt};
use canopen_stm32f4::chip;
use emulator::{
    Time,
    board::{self, Board},
    can::{self, Adapter, Clock, Id},
    chip::{Part, ResetCause},
    image::Image,
    network::{AdapterId, Network, Recording},
};
use testkit::{
    boards,
    cargo::workspace,
    wire::{bit_per_s, from_the_wire, on_the_wire},
};
use xtask::example::{self, Example};

/// The bit rate and the node-ID of the board.
const BIT_RATE: BitRate = BitRate::Kbit500;
const NODE: u8 = 5;

/// Run the cases of a conformance test of CANopen against release images
///
/// The cases have the numbers and purposes of CiA's Conformance Test Tool, and are driven by the data sheet of the
/// image as the tool's are: docs/conformance.md. Beside them are cases of our own, and those of LSS, which run on
/// five boards. They run on the emulated bus in virtual time; `cargo hil --conformance` runs the same cases on a real
/// adapter.
///
/// Without options they run for the default image and for the example io. It ends with 0 if no case failed, with 1
/// otherwise.
#[derive(clap::Args)]
#[command(verbatim_doc_comment)]
pub struct Arguments {
    /// Run only this image: default or io; can be repeated
    #[arg(long, value_name = "NAME")]
    image: Vec<ImageName>,
    /// Run this program in place of an image of ours
    #[arg(long, value_name = "FILE", requires = "eds", conflicts_with = "image")]
    elf: Option<PathBuf>,
    /// The data sheet of --elf
    #[arg(long, value_name = "FILE", requires = "elf")]
    eds: Option<PathBuf>,
    /// The chip on the board
    #[arg(long, default_value = testkit::image::PART.name())]
    chip: Part,
    /// The CAN controller of --elf on the bus: can1, can2, or on some chips can3
    #[arg(long, default_value = "can1", value_parser = chip::controller, requires = "elf")]
    controller: u8,
    /// The crystal on the board of --elf, in MHz
    #[arg(long, default_value_t = 8, value_name = "MHZ", value_parser = clap::value_parser!(u8).range(4..=26), requires = "elf")]
    crystal: u8,
    /// Run only these cases; can be repeated
    #[arg(long, value_enum)]
    chapter: Vec<Chapter>,
    /// Run only the cases whose number begins so, such as "PDO 23" or PDO; can be repeated
    #[arg(long, value_name = "NUMBER")]
    case: Vec<String>,
    /// Write the report as an HTML page
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
    /// Write the report as JUnit XML
    #[arg(long, value_name = "FILE")]
    junit: Option<PathBuf>,
    /// Show the frames of each case
    #[arg(long)]
    frames: bool,
}

/// A list of groups of cases.
#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Chapter {
    /// The application layer, numbered as in the certifier's tool
    Cia301,
    /// Rules of the application layer that no case of that tool looks at
    Own,
    /// LSS, which that tool does not test
    Lss,
}

impl Chapter {
    const ALL: [Self; 3] = [Self::Cia301, Self::Own, Self::Lss];

    const fn groups(self) -> &'static [Group] {
        match self {
            Self::Cia301 => APPLICATION_LAYER,
            Self::Own => OWN,
            Self::Lss => LSS,
        }
    }

    const fn name(self) -> &'static str {
        match self {
            Self::Cia301 => "the certifier's cases",
            Self::Own => "our own cases",
            Self::Lss => "LSS",
        }
    }
}

/// An image of this repository.
#[derive(Clone, Copy, clap::ValueEnum)]
enum ImageName {
    /// The plain firmware
    Default,
    /// The example `io`
    Io,
}

impl ImageName {
    const fn example(self) -> Option<Example> {
        match self {
            Self::Default => None,
            Self::Io => Some(Example::Io),
        }
    }

    const fn eds(self) -> &'static str {
        match self {
            Self::Default => "eds/lss-slave.eds",
            Self::Io => "eds/io.eds",
        }
    }
}

/// A program, its board and its data sheet.
struct Product {
    name: String,
    chip: Part,
    board: board::Settings,
    image: Image,
    eds: Eds,
}

/// Runs the cases, prints their outcomes, and writes the reports. Fails if a case failed.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let begin = Instant::now();
    let mut reports = Vec::new();
    let is_wanted = |chapter: &Chapter| {
        let is_named = arguments.chapter.is_empty() || arguments.chapter.contains(chapter);
        is_named && ::conformance::has_case(chapter.groups(), &arguments.case)
    };
    for product in products(arguments)? {
        for chapter in Chapter::ALL.into_iter().filter(is_wanted) {
            let report = test(&product, chapter, arguments)?;
            println!();
            reports.push(report);
        }
    }
    ensure!(!reports.is_empty(), "no case begins with {}", arguments.case.join(" or "));
    for report in &reports {
        println!("{}", report.summary());
    }
    println!("{:.1} s", begin.elapsed().as_secs_f64());
    let write = |path: &Option<PathBuf>, content: fn(&[Report]) -> String| match path {
        Some(path) => fs::write(path, content(&reports))
            .with_context(|| format!("cannot write {}", path.display())),
        None => Ok(()),
    };
    write(&arguments.html, ::conformance::html)?;
    write(&arguments.junit, ::conformance::junit)?;
    ensure!(reports.iter().all(|report| report.failed() == 0), "a case failed");
    Ok(())
}

fn products(arguments: &Arguments) -> anyhow::Result<Vec<Product>> {
    let read = |path: &Path| Eds::read(path).map_err(anyhow::Error::msg);
    if let (Some(elf), Some(eds)) = (&arguments.elf, &arguments.eds) {
        let chip = arguments.chip;
        let name = elf.file_name().unwrap_or_default().to_string_lossy();
        let name = format!("{name} on {}", chip.name());
        let crystal = Clock { hz: u32::from(arguments.crystal) * 1_000_000, ppm: 0 };
        let controller = arguments.controller.into();
        let board = board::Settings {
            crystal,
            controller,
            tolerates_unmodelled: true,
            ..Default::default()
        };
        let (image, eds) = (Image::load(elf)?, read(eds)?);
        return Ok(vec![Product { name, chip, board, image, eds }]);
    }
    let images: Vec<(ImageName, Part)> = match &arguments.image[..] {
        [] => [ImageName::Default, ImageName::Io].map(|name| (name, arguments.chip)).to_vec(),
        names => names.iter().map(|name| (*name, arguments.chip)).collect(),
    };
    let product = |(product, chip): (ImageName, Part)| {
        let image = example::image(chip, product.example())?;
        let eds = read(&workspace().join(product.eds()))?;
        let name = format!("{} on {}", product.eds().trim_start_matches("eds/"), chip.name());
        let board = example::board(product.example());
        Ok(Product { name, chip, board, image, eds })
    };
    images.into_iter().map(product).collect()
}

fn test(product: &Product, chapter: Chapter, arguments: &Arguments) -> anyhow::Result<Report> {
    let boards = if chapter == Chapter::Lss { UNIQUE_IDS.len() } else { 1 };
    let mut bus = Bus::new(product, boards);
    let mut bench = Bench::new(Line::Lab(&mut bus), &product.eds, NODE);
    bench.lss = Target::new(addresses(product, boards), BIT_RATE, Vec::new());
    let mut report = Report::new(format!("{}, {}", product.name, chapter.name()));
    println!("{}", report.device);
    ::conformance::run(&mut bench, chapter.groups(), &arguments.case, &mut report, |finding| {
        println!("{}", finding.line());
        if arguments.frames {
            println!("{}", finding.frames().join("\n"));
        }
    })?;
    Ok(report)
}

/// Unique ids whose serial numbers are 1E00h, 1275h, 2469h, 0010 1E00h and 8000 1234h: who has one between 1276h and
/// 2468h? The first and the fourth differ in one bit.
const UNIQUE_IDS: [[u8; 12]; 5] = [
    *b"\0\0\0\0\x0AEMU\xB9\xD3\xF4\x52",
    *b"\0\0\0\0\x07EMU\x12\xDB\xFC\x73",
    *b"\0\0\0\0\x07EMU\x27\x1C\xFE\x41",
    *b"\0\0\0\0\x07EMU\x81\xD6\x6B\x59",
    *b"\0\0\0\0\x07EMU\x1D\xE0\xC7\xDF",
];

/// The LSS addresses of the first `count` boards.
fn addresses(product: &Product, count: usize) -> Vec<Address> {
    let number = |sub_index| {
        let entry = product.eds.get((0x1018, sub_index));
        let default = entry.and_then(|entry| entry.default(NODE)).unwrap_or_default();
        default.iter().rev().fold(0, |number, byte| number << 8 | u32::from(*byte))
    };
    let address = |id: &[u8; 12]| Address {
        vendor_id: number(1),
        product_code: number(2),
        revision_number: number(3),
        serial_number: Address::serial_number_of(id),
    };
    UNIQUE_IDS.iter().take(count).map(address).collect()
}

/// The emulated bus with its boards, and the adapter on it.
struct Bus {
    network: Network,
    adapter: AdapterId,
    /// The number of boards that are on the bus: the first ones.
    attached: usize,
    /// The commands NMT reset node that a board may have received.
    resets: usize,
    start: Instant,
}

impl Bus {
    /// The boards, each with a stored node-ID, after their start.
    fn new(product: &Product, boards: usize) -> Self {
        let mut network = Network::new();
        network.record(Recording::Off);
        let adapter = network.add_adapter(Adapter::new(bit_per_s(BIT_RATE)));
        for (unique_id, node) in UNIQUE_IDS.into_iter().take(boards).zip(NODE..) {
            let settings = board::Settings { unique_id, ..product.board };
            let mut board = Board::new(product.chip, &product.image, settings);
            let mut flash = board.flash();
            let settings = Settings::new(BIT_RATE.into()).with_node_id(NodeId::new(node));
            boards::store_settings(&mut flash, settings.into());
            board.set_flash(0, &flash);
            network.add_board(board);
        }
        network.run_for(boards::FIRST_START);
        Self { network, adapter, attached: boards, resets: 0, start: Instant::now() }
    }

    /// Ends the run if a board has misused its chip, is locked up, or has restarted unasked.
    fn check(&self) -> Result<(), Stop> {
        self.network.boards().iter().try_for_each(|board| self.check_board(board))
    }

    fn check_board(&self, board: &Board) -> Result<(), Stop> {
        let causes = board.resets().iter().map(|(_, cause)| *cause);
        let others = causes.filter(|cause| *cause != ResetCause::PowerOn).collect::<Vec<_>>();
        let is_asked = others.len() <= self.resets
            && others.iter().all(|cause| *cause == ResetCause::Software);
        match (board.misuse(), board.lockup()) {
            (Some(finding), _) => {
                Err(Stop::Bench(format!("the board misuses its chip: {finding}")))
            }
            (None, Some(lockup)) => Err(Stop::Bench(format!("the board is locked up: {lockup:?}"))),
            (None, None) if is_asked => Ok(()),
            (None, None) => Err(Stop::Bench(format!("unexpected resets of the board: {others:?}"))),
        }
    }
}

fn duration(time: Time) -> Duration {
    Duration::from_nanos(time.as_ns())
}

impl adapter::Adapter for Bus {
    fn open(&mut self, rate: BitRate, _: Mode) -> Result<(), Stop> {
        self.network.adapter_mut(self.adapter).set_bit_rate(bit_per_s(rate));
        Ok(())
    }

    fn close(&mut self) -> Result<(), Stop> {
        self.network.adapter_mut(self.adapter).close();
        Ok(())
    }

    fn send(&mut self, frame: &Frame) -> Result<(), Stop> {
        self.network.send(self.adapter, on_the_wire(frame));
        let is_reset = frame.cob_id() == nmt::COMMAND_COB_ID && frame.data().first() == Some(&0x81);
        self.resets += usize::from(is_reset);
        Ok(())
    }

    fn receive(&mut self, wait: Duration) -> Result<Option<Received>, Stop> {
        let wait = Time::from_ns(wait.as_nanos() as u64);
        let received = self.network.run_until_received(self.adapter, wait);
        self.check()?;
        Ok(received.and_then(|(time, frame)| {
            let (frame, at) = (from_the_wire(&frame)?, duration(time));
            Some(Received { frame, at, here: self.start + at })
        }))
    }

    fn send_remote(&mut self, cob_id: u16, length: u8) -> Result<bool, Stop> {
        self.network.send(self.adapter, can::Frame::remote(Id::Standard(cob_id), length));
        Ok(true)
    }

    fn send_extended(&mut self, id: u32, data: &[u8]) -> Result<bool, Stop> {
        self.network.send(self.adapter, can::Frame::data(Id::Extended(id), data));
        Ok(true)
    }

    fn now(&self) -> Instant {
        self.start + duration(self.network.now())
    }

    fn description(&self) -> String {
        "emulated boards".into()
    }
}

impl Lab for Bus {
    fn power(&mut self, is_on: bool) {
        for board in 0..self.attached {
            match is_on {
                true => self.network.power_on(board),
                false => self.network.power_off(board),
            }
        }
    }

    fn attach(&mut self, count: usize) {
        let boards = self.network.boards().len();
        if count != self.attached {
            (count..boards).for_each(|board| self.network.power_off(board));
            (0..count).for_each(|board| self.network.power_on(board));
            self.attached = count;
            self.network.run_for(boards::FIRST_START);
        }
    }

    fn unsent(&mut self) -> usize {
        self.network.adapter_mut(self.adapter).unsent()
    }

    fn fail_stores(&mut self, fails: bool) {
        let failing = if fails { u32::MAX } else { 0 };
        self.network.board(0).chip().flash_mut().fail_programs(failing);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_boards_have_the_serial_numbers_of_the_lss_chapter() {
        let serial_numbers = UNIQUE_IDS.map(|id| Address::serial_number_of(&id));
        assert_eq!(serial_numbers, [0x1E00, 0x1275, 0x2469, 0x0010_1E00, 0x8000_1234]);
    }
}
