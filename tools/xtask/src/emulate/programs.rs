//! Programs of others, which run beside the boards with our firmware: their output, and what they touched.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, ensure};
use emulator::{
    Time,
    board::{Board, Settings},
    chip::{FLASH_BASE, Part, ResetCause},
    image::Image,
    network::Network,
};
use testkit::{
    boards,
    log::{Decoder, LogLine},
    release::read_hex,
    unmodelled::{self, function_at},
};

use super::memory::Memory;

/// The programs, each on a board of its own after ours.
#[derive(Default)]
pub struct Programs(Vec<Program>);

struct Program {
    /// The number of its board.
    number: usize,
    name: String,
    part: Part,
    image: Image,
    log: Decoder,
}

impl Programs {
    /// Puts each ELF file on a board of its own with this chip and these settings.
    ///
    /// # Errors
    /// A file cannot be read, or the chip does not start with it.
    pub fn load(
        paths: &[PathBuf],
        part: Part,
        settings: Settings,
        memory: &mut Memory,
        network: &mut Network,
    ) -> anyhow::Result<Self> {
        let mut loaded = Self::default();
        for path in paths {
            let image = load(path)?;
            check(&image, part).with_context(|| path.display().to_string())?;
            let number = network.boards().len();
            let settings = Settings { unique_id: boards::unique_id(number), ..settings };
            let mut board = Board::new(part, &image, settings);
            memory.restore(&mut board, &image, number, None)?;
            network.add_board(board);
            loaded.0.push(Program::new(number, path, part, image)?);
        }
        Ok(loaded)
    }

    /// The number of each program's board, with its name.
    pub fn names(&self) -> impl Iterator<Item = String> {
        self.0.iter().map(|program| format!("board {}: {}", program.number, program.name))
    }

    /// The boards with our firmware.
    pub fn ours<'a>(&self, network: &'a Network) -> &'a [Board] {
        &network.boards()[..network.boards().len() - self.0.len()]
    }

    /// Prints the log and the serial lines that have come since the last call.
    pub fn print(&mut self, network: &Network) {
        for program in &mut self.0 {
            for line in program.new_lines(network.board(program.number)) {
                println!("{line}");
            }
        }
    }

    /// A report on each program: its time, and every access that a chip does not tolerate or the board does not model.
    pub fn report(&self, network: &Network) -> String {
        self.0.iter().map(|program| program.report(network.board(program.number))).collect()
    }

    /// Whether none has locked up or done what a chip does not tolerate.
    pub fn are_tolerable(&self, network: &Network) -> bool {
        let mut boards = self.0.iter().map(|program| network.board(program.number));
        boards.all(|board| {
            let findings = board.findings();
            board.lockup().is_none() && findings.iter().all(|it| board.chip().is_tolerable(it))
        })
    }
}

/// The program in an ELF file or in an Intel HEX file.
fn load(path: &Path) -> anyhow::Result<Image> {
    if path.extension().is_none_or(|extension| extension != "hex") {
        return Ok(Image::load(path)?);
    }
    let context = || path.display().to_string();
    let bytes = read_hex(&fs::read_to_string(path).with_context(context)?).with_context(context)?;
    let mut segments: Vec<(u32, Vec<u8>)> = Vec::new();
    for (address, byte) in bytes {
        match segments.last_mut() {
            Some((start, bytes)) if *start + bytes.len() as u32 == address => bytes.push(byte),
            _ => segments.push((address, vec![byte])),
        }
    }
    Ok(Image::from_segments(segments))
}

fn check(image: &Image, part: Part) -> anyhow::Result<()> {
    let end = FLASH_BASE + part.flash_size();
    let mut starts = false;
    for (address, bytes) in image.segments() {
        let fits = address >= FLASH_BASE && u64::from(address) + bytes.len() as u64 <= end.into();
        ensure!(fits, "{address:08x} is not in the flash of {}: another --chip?", part.name());
        starts |= address == FLASH_BASE;
    }
    ensure!(starts, "there is nothing at {FLASH_BASE:08x}, where the chip starts");
    Ok(())
}

impl Program {
    fn new(number: usize, path: &Path, part: Part, image: Image) -> anyhow::Result<Self> {
        let name = path.file_name().map_or_else(String::new, |name| name.display().to_string());
        let log = Decoder::new(&image)
            .with_context(|| format!("the log of {} cannot be read", path.display()))?;
        Ok(Self { number, name, part, image, log })
    }

    fn new_lines(&mut self, board: &Board) -> Vec<String> {
        let log = self.log.new_lines(board);
        let text = |line: LogLine| {
            format!("{:>14}  {}: {:5} {}", line.time, self.name, line.level, line.text)
        };
        log.into_iter().map(text).collect()
    }

    fn report(&self, board: &Board) -> String {
        let (cycles, busy) = board.cycles();
        let resets = board.resets();
        let last_on = resets.iter().rposition(|(_, cause)| *cause == ResetCause::PowerOn);
        let (switched_on, resets) = resets.split_at(last_on.map_or(0, |index| index + 1));
        let since = switched_on.last().map_or(Time::ZERO, |(time, _)| *time);
        let mut report = format!(
            "{} on {}: {} ms, awake for {} % of it",
            self.name,
            self.part.name(),
            (board.now() - since).as_ms(),
            100 * busy / cycles.max(1)
        );
        let resets: Vec<String> =
            resets.iter().map(|(time, cause)| format!("{cause:?} at {time} ms")).collect();
        if !resets.is_empty() {
            report += &format!("\n  reset: {}", resets.join(", "));
        }
        if let Some(lockup) = board.lockup() {
            report +=
                &format!("\n  locked up at {}: {lockup:x?}", function_at(&self.image, board.pc()));
        }
        let findings = board.findings();
        if findings.is_empty() {
            report += "\n  it touched nothing that the board does not model";
        }
        for finding in findings.iter().filter(|finding| !board.chip().is_tolerable(finding)) {
            report += &format!("\n  {finding}, in {}", function_at(&self.image, finding.pc));
        }
        for line in unmodelled::report(board) {
            report += &format!("\n  {line}");
        }
        report + "\n"
    }
}

#[cfg(test)]
mod tests {
    use testkit::image::PART;

    use super::*;

    /// Loads a word from `address` and stops.
    fn program_that_reads(address: u32) -> Image {
        let half = |word: u32| {
            [
                0xF240 | word >> 12 | (word >> 11 & 1) << 10,
                (word >> 8 & 7) << 12 | 7 << 8 | word & 0xFF,
            ]
        };
        let [low, high] = [half(address & 0xFFFF), half(address >> 16)];
        let code = [low[0], low[1], high[0] | 0x80, high[1], 0x6838, 0xE7FE];
        let vectors = [0x2000_1000_u32, FLASH_BASE + 9];
        let code = code.into_iter().flat_map(|half| (half as u16).to_le_bytes());
        let bytes = vectors.into_iter().flat_map(u32::to_le_bytes).chain(code).collect();
        Image::from_segments(vec![(FLASH_BASE, bytes)])
    }

    fn report_on(image: Image) -> String {
        let mut network = Network::new();
        let program =
            Program::new(0, Path::new("dir/a.elf"), PART, image.clone()).expect("it has no log");
        let mut programs = Programs(vec![program]);
        network.add_board(boards::board(PART, &image, 0));
        network.run_for(Time::from_ms(5));
        programs.print(&network);
        programs.report(&network)
    }

    #[test]
    fn the_report_names_each_access_that_is_not_modelled() {
        let report = report_on(program_that_reads(0x4000_5400));
        assert!(report.starts_with("a.elf on stm32f407: 5 ms"), "{report}");
        let line = "\n  not modelled: I2C1, offset 00h, read once by 08000010\n";
        assert!(report.contains(line), "{report}");
        let report = report_on(program_that_reads(0x4002_3800));
        assert!(report.contains("it touched nothing that the board does not model"), "{report}");
        let report = report_on(program_that_reads(0x6000_0000));
        assert!(report.contains("locked up at"), "{report}");
    }

    #[test]
    fn a_program_that_the_chip_does_not_start_is_refused() {
        let refusal = |address| {
            let image = Image::from_segments(vec![(address, vec![0; 8])]);
            check(&image, Part::Stm32f446).expect_err("refused").to_string()
        };
        assert!(refusal(0x2000_0000).contains("is not in the flash"));
        assert!(refusal(0x0808_0000).contains("another --chip?"));
        assert!(refusal(0x0800_4000).contains("nothing at 08000000"));
        let mut network = Network::new();
        let (part, settings) = (PART, Settings::default());
        let mut memory = Memory::open(None).expect("there are no files");
        let paths = ["no/such".into()];
        let missing = Programs::load(&paths, part, settings, &mut memory, &mut network);
        assert!(missing.is_err_and(|error| error.to_string().contains("no/such")));
    }
}
