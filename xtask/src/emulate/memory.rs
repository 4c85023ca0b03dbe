//! The boards' flash in files: what is stored in one run is there in the next.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

use anyhow::{Context, ensure};
use emulator::{board::Board, chip::FLASH_BASE, image::Image, network::Network};
use lss_slave::Settings;

use crate::boards;

/// The files, or nothing where none are wanted.
pub struct Memory {
    directory: Option<PathBuf>,
    /// Of each board, how many flash operations are in its file.
    saved: Vec<Option<u64>>,
}

impl Memory {
    /// Files in `directory`, which is made if it is missing.
    pub fn open(directory: Option<&Path>) -> anyhow::Result<Self> {
        if let Some(directory) = directory {
            fs::create_dir_all(directory)
                .with_context(|| format!("cannot make {}", directory.display()))?;
        }
        Ok(Self { directory: directory.map(Path::to_owned), saved: Vec::new() })
    }

    /// Fills the flash of a board that has not run yet: from its file, with the program of today over it; where
    /// nothing is stored then, with `preset`.
    pub fn restore(
        &mut self,
        board: &mut Board,
        image: &Image,
        number: usize,
        preset: Option<Settings>,
    ) -> anyhow::Result<()> {
        let mut flash = board.flash();
        if let Some(path) = self.path(number) {
            match fs::read(&path) {
                Ok(bytes) => {
                    ensure!(
                        bytes.len() == flash.len(),
                        "{} has {} bytes instead of {}: it is no flash of this chip; move it away",
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
        for (number, board) in network.boards().iter().enumerate() {
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

/// Writes a file so that at any time either the old or the new content is there, whole.
fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let new = path.with_extension("bin.new");
    fs::write(&new, content)?;
    fs::File::open(&new)?.sync_all()?;
    fs::rename(new, path)
}
