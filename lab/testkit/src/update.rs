//! Update files, and the flash of boards with a loader.

use anyhow::{Context, ensure};
use canopen_node::Device;
use canopen_stm32f4::chip::{Chip, RUN};
use emulator::{chip::Part, image::Image};
use program_update::{
    Header, Release, crc,
    header::{HEADER_LEN, text},
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

/// The flash of a board as it leaves production: the loader, and the program of an update file.
pub fn factory(loader: &Image, file: &[u8]) -> Image {
    let of_loader = loader.segments().map(|(address, bytes)| (address, bytes.to_vec()));
    Image::from_segments(of_loader.chain([(RUN, file.to_vec())]).collect())
}
