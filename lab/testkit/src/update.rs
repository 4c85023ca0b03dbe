//! Update files, and the flash of boards with a loader.

use std::{
    env, fs,
    path::{Path, PathBuf},
    process::Command,
};

use anyhow::{Context, bail, ensure};
use canopen_node::Device;
use canopen_stm32f4::chip::{Chip, Run};
pub use ed25519_dalek::SigningKey;
use ed25519_dalek::{Signer, pkcs8::DecodePrivateKey};
use emulator::{
    chip::{FLASH_BASE, Part},
    image::Image,
};
use program_update::{
    Header, Release, crc,
    header::{Field, HEADER_LEN, SIGNED_LEN, text},
    journal,
    signature::{Digest, Sha256},
};

use crate::{
    hex,
    image::{self, Product},
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
    file_in(
        Chip::named(part.name()).context("no chip of a product")?.run(false),
        program,
        device,
        part,
        controller,
    )
}

/// The same for a loader that takes only signed programs.
pub fn signed_file(
    program: &Image,
    device: &Device,
    part: Part,
    controller: u8,
    key: &SigningKey,
) -> anyhow::Result<Vec<u8>> {
    let chip = Chip::named(part.name()).context("no chip of a product")?;
    let mut file = file_in(chip.run(true), program, device, part, controller)?;
    let (header, program) = file.split_first_chunk_mut().context("a header")?;
    let mut fields = Header::parse(header).ok().context("a header")?;
    fields.sha256 = Sha256::digest(program).into();
    fields.signature = key.sign(&fields.to_bytes()[..SIGNED_LEN]).to_bytes();
    *header = fields.to_bytes();
    Ok(file)
}

fn file_in(
    run: Run,
    program: &Image,
    device: &Device,
    part: Part,
    controller: u8,
) -> anyhow::Result<Vec<u8>> {
    let start = run.address + HEADER_LEN as u32;
    let mut content = Vec::new();
    for (address, bytes) in program.segments() {
        let offset = address.checked_sub(start).context("the program does not begin at RUN")?;
        let end = offset as usize + bytes.len();
        content.resize(content.len().max(end), ERASED);
        content[offset as usize..end].copy_from_slice(bytes);
    }
    content.resize(content.len().next_multiple_of(4), ERASED);
    ensure!(
        content.len() + HEADER_LEN <= (run.kb * 1024) as usize,
        "the program is too long for {}",
        part.name()
    );
    let header = Header {
        length: content.len() as u32,
        crc: crc::of(&content),
        vendor_id: device.address.vendor_id,
        product_code: device.address.product_code,
        revision_number: device.address.revision_number,
        release: Release::parse(device.software_version).context("a version is three numbers")?,
        chip: text(part.name()),
        hardware: crc::of(device.hardware_version.as_bytes()),
        address: run.address,
        controller: controller.into(),
        version: text(device.software_version),
        sha256: [ERASED; 32],
        signature: [ERASED; 64],
    };
    Ok([&header.to_bytes()[..], &content].concat())
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
    let address = Field::Address as usize;
    let run = u32::from_le_bytes(file[address..address + 4].try_into().expect("four bytes"));
    Image::from_segments(of_loader.chain([(run, file.to_vec())]).collect())
}

/// A product with its loader, and a program without a signature, which a loader starts too: the flash of a new board.
///
/// # Errors
/// It does not build.
pub fn build_product(directory: &str, name: &str, device: &Device) -> anyhow::Result<Product> {
    let program = Product::build(directory, name)?;
    let loader = image::build_loader(Path::new(directory), name, |_| ())?;
    let chip = Chip::named(program.part.name()).context("no chip of a product")?;
    let begins = program.image.segments().map(|(address, _)| address).min();
    let is_signed = begins == Some(chip.run(true).address + HEADER_LEN as u32);
    let run = chip.run(is_signed);
    let file = file_in(run, &program.image, device, program.part, program.controller)?;
    Ok(Product { image: factory(&in_flash(&Image::from_elf(&loader)?)?, &file), ..program })
}

/// The files with which loader and program of a product get onto boards, with their names.
pub fn files(
    name: &str,
    [loader, program]: &[Image; 2],
    device: &Device,
    part: Part,
    controller: u8,
    key: Option<&SigningKey>,
) -> anyhow::Result<Vec<(String, Vec<u8>)>> {
    let file = match key {
        Some(key) => signed_file(program, device, part, controller, key)?,
        None => file(program, device, part, controller)?,
    };
    let chip = Chip::named(part.name()).context("no chip of a product")?;
    // A board that was updated before has a journal there, which says otherwise.
    let run = chip.run(key.is_some());
    let journal = run.address + run.kb * 1024 + journal::OFFSET;
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

/// `cargo update-file [--key PEM] [FOLDER]` of the product in a folder, whose package has this name: builds loader and
/// program, and writes the files. `loader_key` is the key of a loader that takes only signed programs; one of zeros is
/// exchanged for that of the PEM.
pub fn run(
    product: &Path,
    name: &str,
    device: &Device,
    loader_key: Option<&[u8; 32]>,
) -> anyhow::Result<()> {
    let mut arguments = env::args_os().skip(1);
    let (mut folder, mut key) = (product.join("target/update"), None);
    while let Some(argument) = arguments.next() {
        if argument == "--key" {
            key = Some(read_key(&PathBuf::from(arguments.next().context("--key PEM")?))?);
        } else {
            folder = argument.into();
        }
    }
    check_key(product, key.as_ref(), loader_key)?;
    let (part, controller) = image::board_of(product)?;
    let loader = image::build_loader(product, name, |_| ())?;
    let program = image::build_with(product, name, image::OF_PRODUCT, |_| ())?;
    let images = [in_flash(&Image::from_elf(&loader)?)?, Image::from_elf(&program)?];
    fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    for (name, content) in files(name, &images, device, part, controller, key.as_ref())? {
        let path = folder.join(name);
        fs::write(&path, content).with_context(|| format!("cannot write {}", path.display()))?;
        println!("{}", path.display());
    }
    Ok(())
}

/// `key.rs` of the template with a key.
pub(crate) fn with_key(template: &str, key: &[u8; 32]) -> String {
    template.replace("= [0; 32]", &format!("= {key:?}"))
}

/// The key in the template.
const NO_KEY: &[u8; 32] = &[0; 32];

/// The private key in a file as `openssl genpkey -algorithm ed25519` writes it.
fn read_key(path: &Path) -> anyhow::Result<SigningKey> {
    let text =
        fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    SigningKey::from_pkcs8_pem(&text)
        .with_context(|| format!("{} has no private key of Ed25519", path.display()))
}

/// Fails unless the loader takes what the key signs. A loader without a key gets this one.
fn check_key(
    product: &Path,
    key: Option<&SigningKey>,
    loader_key: Option<&[u8; 32]>,
) -> anyhow::Result<()> {
    let key = key.map(|key| key.verifying_key().to_bytes());
    match (key, loader_key) {
        (Some(key), Some(NO_KEY)) => {
            let path = product.join("src/key.rs");
            let text = fs::read_to_string(&path)
                .with_context(|| format!("cannot read {}", path.display()))?;
            fs::write(&path, with_key(&text, &key))
                .with_context(|| format!("cannot write {}", path.display()))?;
            // A key that is written over several lines, or not, is the same.
            let _ = Command::new("rustfmt").arg(&path).status();
            println!("{}", path.display());
        }
        (Some(key), Some(loader_key)) => {
            ensure!(
                key == *loader_key,
                "the loader has another key; programs signed with this one want other boards, with\n\npub const KEY: [u8; 32] = {key:?};\n\nin src/key.rs"
            );
        }
        (None, Some(_)) => bail!("the loader takes only signed programs: give `--key PEM`"),
        (Some(_), None) => {
            bail!("the loader checks no signature: make the product with `--signed`")
        }
        (None, None) => {}
    }
    Ok(())
}
