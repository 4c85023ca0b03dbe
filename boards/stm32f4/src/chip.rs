//! The chips that a board may have, and what the drivers rely on of each.

/// An STM32F4 with bxCAN. The sizes are those of its smallest version, which the image must fit. On every chip sectors
/// 0 to 3 of the flash have 16 KB (chapter "Embedded flash memory interface" of each manual; of RM0402 and RM0430 that
/// table was not available: there the flash algorithms of the STM32F4 device pack 2.17.1 say so).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chip {
    /// The feature of the firmware, the chip's name in lower case.
    pub feature: &'static str,
    /// The reference manual.
    pub manual: &'static str,
    /// KB of flash.
    pub flash_kb: u32,
    /// KB of RAM from 2000_0000h on, which adjoin.
    pub ram_kb: u32,
    /// The highest clock of the core without over-drive, in MHz.
    pub max_sysclk_mhz: u32,
    /// The highest clock of APB1 without over-drive, in MHz.
    pub max_apb1_mhz: u32,
    /// The number of CAN controllers.
    pub controllers: u32,
    /// DEV_ID in DBGMCU_IDCODE (chapter "Debug support" of the manual).
    pub device_id: u32,
    /// The name in probe-rs; the package makes no difference.
    pub probe_rs: &'static str,
    /// Whether the features of the build select it.
    pub is_selected: bool,
}

/// The place of a program that can be replaced over the bus, which begins with its header. As many sectors after those are
/// BACKUP, which has a copy of the program before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Run {
    /// Its first sector.
    pub first_sector: u32,
    /// The number of its sectors.
    pub sectors: u32,
    /// Its address.
    pub address: u32,
    /// Its size in KB.
    pub kb: u32,
}

/// KB of each sector from 5 on, and of sector 4.
const LARGE_KB: u32 = 128;
const SECTOR_4_KB: u32 = 64;

impl Chip {
    /// The chip of this feature.
    pub fn named(feature: &str) -> Option<Self> {
        CHIPS.into_iter().find(|chip| chip.feature == feature)
    }

    /// The chip that the manifest of a product names: `"canopen-stm32f4/stm32f446"`.
    pub fn of_manifest(manifest: &str) -> Option<Self> {
        let features = manifest.split("\"canopen-stm32f4/").skip(1);
        features.filter_map(|rest| rest.split('"').next()).find_map(Self::named)
    }

    /// RUN begins with sector 4. A loader that takes only signed programs needs that sector itself, so RUN begins with
    /// sector 5 behind it; a chip with 256 KB has no room for such a program, and RUN has no sector.
    pub const fn run(&self, is_signed: bool) -> Run {
        let large = self.flash_kb / LARGE_KB - 1;
        if is_signed {
            let sectors = large / 2;
            return Run { first_sector: 5, sectors, address: 0x0802_0000, kb: sectors * LARGE_KB };
        }
        let sectors = large.div_ceil(2);
        let kb = (sectors - 1) * LARGE_KB + SECTOR_4_KB;
        Run { first_sector: 4, sectors, address: 0x0801_0000, kb }
    }
}

macro_rules! chips {
    ($(
        $feature:literal $manual:ident $flash_kb:literal $ram_kb:literal $sysclk:literal $apb1:literal
        $controllers:literal $device_id:literal $probe_rs:literal;
    )*) => {
        [$(Chip {
            feature: $feature,
            manual: stringify!($manual),
            flash_kb: $flash_kb,
            ram_kb: $ram_kb,
            max_sysclk_mhz: $sysclk,
            max_apb1_mhz: $apb1,
            controllers: $controllers,
            device_id: $device_id,
            probe_rs: $probe_rs,
            is_selected: cfg!(feature = $feature),
        },)*]
    };
}

/// Every chip, in the order of their numbers.
pub const CHIPS: [Chip; 14] = chips! {
    // feature, manual, KB of flash and RAM, MHz of core and APB1, CAN controllers, DEV_ID, name in probe-rs
    "stm32f405" RM0090  512 128 168 42 2 0x413 "STM32F405RGTx";
    "stm32f407" RM0090  512 128 168 42 2 0x413 "STM32F407VGTx";
    "stm32f412" RM0402  512 256 100 50 2 0x441 "STM32F412VGTx";
    "stm32f413" RM0430 1024 320 100 50 3 0x463 "STM32F413VHTx";
    "stm32f415" RM0090 1024 128 168 42 2 0x413 "STM32F415RGTx";
    "stm32f417" RM0090  512 128 168 42 2 0x413 "STM32F417VGTx";
    "stm32f423" RM0430 1536 320 100 50 3 0x463 "STM32F423VHTx";
    "stm32f427" RM0090 1024 192 168 42 2 0x419 "STM32F427VITx";
    "stm32f429" RM0090  512 192 168 42 2 0x419 "STM32F429VITx";
    "stm32f437" RM0090 1024 192 168 42 2 0x419 "STM32F437VITx";
    "stm32f439" RM0090 1024 192 168 42 2 0x419 "STM32F439VITx";
    "stm32f446" RM0390  256 128 168 42 2 0x421 "STM32F446RETx";
    "stm32f469" RM0386  512 320 168 42 2 0x434 "STM32F469VITx";
    "stm32f479" RM0386 1024 320 168 42 2 0x434 "STM32F479VITx";
};

/// The chip of this build. A build for a computer has none: then the first of [`CHIPS`].
pub const CHIP: Chip = {
    let mut i = CHIPS.len() - 1;
    while i > 0 && !CHIPS[i].is_selected {
        i -= 1;
    }
    CHIPS[i]
};

/// The number of a CAN controller: 2 for `can2` or `2`.
///
/// # Errors
/// No chip has a controller of this name.
pub fn controller(name: &str) -> Result<u8, &'static str> {
    match name.strip_prefix("can").unwrap_or(name) {
        "1" => Ok(1),
        "2" => Ok(2),
        "3" => Ok(3),
        _ => Err("choose can1, can2 or can3"),
    }
}

/// RUN of this build.
pub const RUN: Run = CHIP.run(cfg!(feature = "signed"));

/// The address of the 96-bit unique id (RM0090, 39.1; RM0386, 38.1; RM0390 Rev 4, 34.1; RM0402, 31.1; of RM0430 the
/// chapter was not available: there `UID_BASE` in ST's header).
pub const UNIQUE_ID: usize = 0x1FFF_7A10;

/// Sectors 1 and 2 of the flash, which `memory.x` keeps free of code.
pub const SETTINGS: *mut u32 = 0x0800_4000 as *mut u32;

/// The clock of the CAN controllers in Hz: the only whole number of MHz up to 50 with which all eight bit rates are
/// exact and tolerate crystals that are 0.5 % off (docs/reference.md).
pub const APB1_HZ: u32 = 40_000_000;

/// The core clock of a chip in Hz, legal without over-drive and at the voltage scale that it has after a reset. Chips
/// of 100 MHz run at 80 MHz.
pub const fn sysclk_hz(chip: &Chip) -> u32 {
    if chip.max_sysclk_mhz < 160 { 80_000_000 } else { 160_000_000 }
}

/// The core clock of this build.
pub const SYSCLK_HZ: u32 = sysclk_hz(&CHIP);

const _: () = {
    let mut i = 0;
    while i < CHIPS.len() {
        let (chip, sysclk_hz) = (CHIPS[i], sysclk_hz(&CHIPS[i]));
        assert!(sysclk_hz <= chip.max_sysclk_mhz * 1_000_000, "the core clock is too high");
        assert!(APB1_HZ <= chip.max_apb1_mhz * 1_000_000, "the clock of APB1 is too high");
        assert!(matches!(sysclk_hz / APB1_HZ, 2 | 4 | 8 | 16) && sysclk_hz.is_multiple_of(APB1_HZ));
        i += 1;
    }
};
