//! Update files, and the flash of boards with a loader.

use std::{fs, path::Path};

use anyhow::{Context, bail, ensure};
use canopen_node::Device;
use canopen_stm32f4::chip::{Chip, RUN};
use emulator::{
    chip::{FLASH_BASE, Part},
    image::Image,
};
use program_update::{
    Header, Release, crc,
    header::{Field, HEADER_LEN, text},
    journal,
};

use crate::{
    hex, image,
    image_rig::{SETTINGS_LENGTH, SETTINGS_OFFSET},
};

/// The value of an erased byte.
const ERASED: u8 = 0xFF;

/// The update file of a program for this device: header and program. The release is the software version of the
/// device, three numbers such as `1.20.3`.
pub fn file(
    program: &Image,
    device: &Device,
    part: Part,
    controller: u8,
) -> anyhow::Result<Vec<u8>> {
    let chip = Chip::named(part.name()).context("no chip of a product")?;
    let start = RUN + HEADER_LEN as u32;
    let mut content = Vec::new();
    for (address, bytes) in program.segments() {
        let offset = address.checked_sub(start).context("the program does not begin at RUN")?;
        let end = offset as usize + bytes.len();
        content.resize(content.len().max(end), ERASED);
        content[offset as usize..end].copy_from_slice(bytes);
    }
    content.resize(content.len().next_multiple_of(4), ERASED);
    ensure!(
        content.len() + HEADER_LEN <= (chip.run_kb() * 1024) as usize,
        "the program is too long for {}",
        chip.feature
    );
    let header = Header {
        length: content.len() as u32,
        crc: crc::of(&content),
        vendor_id: device.address.vendor_id,
        product_code: device.address.product_code,
        revision_number: device.address.revision_number,
        release: release(device.software_version).context("a version is three numbers")?,
        chip: text(chip.feature),
        hardware: crc::of(device.hardware_version.as_bytes()),
        address: RUN,
        controller: controller.into(),
        version: text(device.software_version),
        sha256: [ERASED; 32],
        signature: [ERASED; 64],
    };
    Ok([&header.to_bytes()[..], &content].concat())
}

/// The release of a version such as `1.20.3`.
fn release(version: &str) -> Option<Release> {
    let mut numbers = version.split('.').map(|number| number.parse().ok());
    let mut next = || numbers.next().flatten();
    Release::new(next()?, next()?, next()?)
}

/// A loader in the flash, around the settings: the file that is linked has it in the RAM (`boards/stm32f4/loader.x`).
pub fn in_flash(linked: &Image) -> anyhow::Result<Image> {
    let mut segments: Vec<_> = linked.segments().collect();
    segments.sort();
    let [(FLASH_BASE, boot), (_, loader)] = segments[..] else { bail!("this is no loader") };
    let in_sector_0 = SETTINGS_OFFSET as usize - boot.len();
    let (first, rest) = loader.split_at_checked(in_sector_0).unwrap_or((loader, &[]));
    let behind = FLASH_BASE + SETTINGS_OFFSET + SETTINGS_LENGTH as u32;
    Ok(Image::from_segments(vec![(FLASH_BASE, [boot, first].concat()), (behind, rest.to_vec())]))
}

/// The flash of a board as it leaves production: the loader, and the program of an update file.
pub fn factory(loader: &Image, file: &[u8]) -> Image {
    let of_loader = loader.segments().map(|(address, bytes)| (address, bytes.to_vec()));
    Image::from_segments(of_loader.chain([(RUN, file.to_vec())]).collect())
}

/// The files with which loader and program of a product get onto boards, with their names.
pub fn files(
    name: &str,
    [loader, program]: &[Image; 2],
    device: &Device,
    part: Part,
    controller: u8,
) -> anyhow::Result<Vec<(String, Vec<u8>)>> {
    let file = file(program, device, part, controller)?;
    let chip = Chip::named(part.name()).context("no chip of a product")?;
    // A board that was updated before has a journal there, which says otherwise.
    let journal = RUN + chip.run_kb() * 1024 + journal::OFFSET;
    let blank = vec![ERASED; 4 * journal::WORDS as usize];
    let factory = factory(loader, &file);
    let factory: Vec<_> = factory.segments().chain([(journal, &blank[..])]).collect();
    let settings = FLASH_BASE + SETTINGS_OFFSET;
    let settings = settings..settings + SETTINGS_LENGTH as u32;
    for (address, bytes) in &factory {
        let end = address + bytes.len() as u32;
        let is_apart = end <= settings.start || settings.end <= *address;
        ensure!(is_apart, "{address:08X}h to {end:08X}h has the settings");
    }
    let loader: Vec<_> = loader.segments().collect();
    let update = format!("{name}.update.bin");
    let crc = u32::from_le_bytes(*file[Field::Crc as usize..].first_chunk().context("a header")?);
    // Lines of a node in the file for `dcfgen`.
    let lely = format!("software_file: {update}\nsoftware_version: 0x{crc:08X}\n");
    Ok(vec![
        ("factory.hex".into(), hex::file(&factory).into_bytes()),
        ("loader.hex".into(), hex::file(&loader).into_bytes()),
        ("lely.yml".into(), lely.into_bytes()),
        (update, file),
    ])
}

/// Builds loader and program of the product in a folder, whose package has this name, and writes the files into another
/// folder.
pub fn write(
    product: &Path,
    folder: &Path,
    name: &str,
    device: &Device,
    part: Part,
    controller: u8,
) -> anyhow::Result<()> {
    let loader = image::build_loader(product, name, part, |_| ())?;
    let program = image::build_with(product, name, part, |_| ())?;
    let images = [in_flash(&Image::from_elf(&loader)?)?, Image::from_elf(&program)?];
    fs::create_dir_all(folder).with_context(|| format!("cannot make {}", folder.display()))?;
    for (name, content) in files(name, &images, device, part, controller)? {
        let path = folder.join(name);
        fs::write(&path, content).with_context(|| format!("cannot write {}", path.display()))?;
        println!("{}", path.display());
    }
    Ok(())
}
