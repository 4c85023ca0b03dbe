//! The boards' flash in files, which keep the stored settings from run to run.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use anyhow::{Context, ensure};

use emulator::{board::Board, chip::FLASH_BASE, image::Image, network::Network};

use testkit::{boards, settings::Stored};

/// The flash files, if they are wanted.
#[derive(Default)]
pub struct Memory {
    directory: Option<PathBuf>,
    /// The number of flash operations of each board when its file was saved.
    saved: Vec<Option<u64>>,
}

impl Memory {
    /// Opens the files in `directory`, which is created if it is missing.
    pub fn open(directory: Option<&Path>) -> anyhow::Result<Self> {
        if let Some(directory) = directory {
            fs::create_dir_all(directory)
                .with_context(|| format!("cannot create {}", directory.display()))?;
        }
        Ok(Self { directory: directory.map(Path::to_owned), saved: Vec::new() })
    }

    /// Fills the flash of a board that has not run yet: from its file, with the current program written over it;
    /// without stored settings, with `preset`.
    pub fn restore(
        &mut self,
        board: &mut Board,
        image: &Image,
        number: usize,
        preset: Option<Stored>,
    ) -> anyhow::Result<()> {
        let mut flash = board.flash();
        if let Some(path) = self.path(number) {
            match fs::read(&path) {
                Ok(bytes) => {
                    ensure!(
                        bytes.len() == flash.len(),
                        "{} has {} bytes instead of {}: it is not a flash file of this chip; move it away",
                        path.display(),
                        bytes.len(),
                        flash.len()
                    );
                    flash = bytes;
                }
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => {
                    return Err(error).with_context(|| format!("cannot read {}", path.display()));
                }
            }
        }
        for (address, bytes) in image.segments() {
            let offset = (address - FLASH_BASE) as usize;
            flash[offset..offset + bytes.len()].copy_from_slice(bytes);
        }
        if let Some(settings) = preset
            && boards::stored_settings(&flash).is_none()
        {
            boards::store_settings(&mut flash, settings);
        }
        board.set_flash(0, &flash);
        self.saved.push(None);
        Ok(())
    }

    /// Writes the files of the boards whose flash has changed.
    pub fn save(&mut self, network: &Network) -> anyhow::Result<()> {
        for (number, board) in network.boards().iter().take(self.saved.len()).enumerate() {
            let Some(path) = self.path(number) else { return Ok(()) };
            let operations = board.chip().flash().operations();
            if self.saved[number] != Some(operations) {
                replace(&path, &board.flash())
                    .with_context(|| format!("cannot write {}", path.display()))?;
                self.saved[number] = Some(operations);
            }
        }
        Ok(())
    }

    fn path(&self, number: usize) -> Option<PathBuf> {
        Some(self.directory.as_ref()?.join(format!("board-{number}.bin")))
    }
}

/// Replaces a file such that an interruption leaves either the old or the new content, complete.
fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let new = path.with_extension("bin.new");
    fs::write(&new, content)?;
    fs::rename(new, path)
}

#[cfg(test)]
mod tests {
    use canopen_node::{BitRate, NodeId, Settings};
    use testkit::image::PART;

    use super::*;

    fn image(byte: u8) -> Image {
        Image::from_segments(vec![(FLASH_BASE, vec![byte; 64])])
    }

    fn settings(id: u8) -> Settings {
        Settings::new(BitRate::Kbit250.into()).with_node_id(NodeId::new(id))
    }

    /// Runs a board with the program `image`, which does nothing; returns the content of its flash.
    fn run(directory: Option<&Path>, image: &Image, preset: Option<Stored>) -> Vec<u8> {
        let mut memory = Memory::open(directory).expect("the directory can be made");
        let mut board = boards::board(PART, image, 0);
        memory.restore(&mut board, image, 0, preset).expect("the file is good or missing");
        let mut network = Network::new();
        network.add_board(board);
        memory.save(&network).expect("the file can be written");
        network.board(0).flash()
    }

    fn new_directory(name: &str) -> PathBuf {
        let directory = std::env::temp_dir().join(format!("{name}-{}", std::process::id()));
        // It exists only if an earlier test was stopped.
        let _ = fs::remove_dir_all(&directory);
        directory
    }

    #[test]
    fn settings_survive_from_run_to_run_under_a_new_program() {
        let directory = new_directory("settings-survive");
        run(Some(&directory), &image(1), Some(settings(5).into()));
        let flash = run(Some(&directory), &image(2), Some(settings(6).into()));
        assert_eq!(boards::stored_settings(&flash), Some(settings(5)));
        assert_eq!(flash[..64], [2; 64]);
        assert_eq!(fs::read(directory.join("board-0.bin")).ok(), Some(flash));
        assert_eq!(fs::read_dir(&directory).expect("it was made").count(), 1);
        fs::remove_dir_all(directory).expect("it was made");
    }

    #[test]
    fn without_a_directory_nothing_survives() {
        run(None, &image(1), Some(settings(5).into()));
        assert_eq!(boards::stored_settings(&run(None, &image(1), None)), None);
    }

    #[test]
    fn a_file_of_another_size_is_refused() {
        let directory = new_directory("another-size");
        let mut memory = Memory::open(Some(&directory)).expect("the directory can be made");
        fs::write(directory.join("board-0.bin"), [0; 100]).expect("the directory was made");
        let mut board = boards::board(PART, &image(1), 0);
        let refusal = memory.restore(&mut board, &image(1), 0, None).expect_err("100 bytes");
        assert!(refusal.to_string().contains("has 100 bytes instead of 1048576"), "{refusal}");
        fs::remove_dir_all(directory).expect("it was made");
    }
}
