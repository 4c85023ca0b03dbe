//! The values of the registers that matter, on the emulated board that runs the same firmware.

use canopen_node::{BitRate, NodeId, bit_rate::BitTiming, lss, nmt};
use canopen_stm32f4::chip::{APB1_HZ, Chip};
use firmware::device;

/// A register, and the value of its bits that do not vary.
#[derive(Clone, Copy, Debug)]
pub struct Register {
    pub name: &'static str,
    pub address: u32,
    pub mask: u32,
    pub value: u32,
}

const CAN_BTR: &str = "CAN_BTR";
const IDCODE: &str = "DBGMCU_IDCODE";
const OPTCR: &str = "FLASH_OPTCR";
const CSR: &str = "PWR_CSR";
const F_SIZE: &str = "size of the flash";
const ALL: u32 = u32::MAX;
/// RCC_PLLCFGR: a crystal of 8 MHz, divided by 4, times 160, divided by 2; the rest is for clocks that are not used.
const PLL: u32 = 0x0740_2804;

const fn register(name: &'static str, address: u32, mask: u32, value: u32) -> Register {
    Register { name, address, mask, value }
}

/// The registers of a board with this node-ID that takes part in the bus at its home rate with this CAN controller, 1
/// for CAN1, of this chip.
pub fn expected(rate: BitRate, id: NodeId, controller: u8, chip: &Chip) -> Vec<Register> {
    let can = 0x4000_6000 + 0x400 * u32::from(controller);
    // CAN2 has its clock and that of CAN1, and banks of CAN1.
    let (clocks, filters, first) = match controller {
        2 => (0b11 << 25, 0x4000_6400, 14),
        _ => (1 << (24 + controller), can, 0),
    };
    let bank = filters + 0x240 + 8 * first;
    // A filter bank in list mode holds four identifiers, each in the upper 11 bits of a half-word.
    let entry = |cob_id: u16| u32::from(cob_id) << 5;
    let pair = |low: u16, high: u16| entry(high) << 16 | entry(low);
    let sdo = 0x600 + u16::from(id.get());
    vec![
        register(IDCODE, 0xE004_2000, 0xFFF, chip.device_id),
        // With the unique id below it; the half-word above is the size in KB.
        register(F_SIZE, 0x1FFF_7A20, 0, 0),
        // No read protection, and no write protection of the sectors for the settings.
        register(OPTCR, 0x4002_3C14, 0x0006_FF00, 0x0006_AA00),
        // The regulator is ready.
        register(CSR, 0x4000_7004, 1 << 14, 1 << 14),
        // HSE, PLL and CSS on, and ready.
        register(
            "RCC_CR",
            0x4002_3800,
            0x030F_0000,
            if device::CRYSTAL_IS_EXTERNAL_CLOCK { 0x030F_0000 } else { 0x030B_0000 },
        ),
        register("RCC_PLLCFGR", 0x4002_3804, 0x0F43_7FFF, PLL),
        // PLL as system clock, and the dividers of the buses.
        register("RCC_CFGR", 0x4002_3808, 0x0000_FCFF, 0x0000_940A),
        // The controller has its clock.
        register("RCC_APB1ENR", 0x4002_3840, clocks, clocks),
        // Wait states, prefetch and caches.
        register("FLASH_ACR", 0x4002_3C00, 0x0000_070F, 0x0000_0705),
        register("CAN_MCR", can, 0x0001_00FF, 0x0001_0040),
        register("CAN_IER", can + 0x14, 0x0003_877F, 0x0000_8603),
        // Neither warning, error passive nor bus-off.
        register("CAN_ESR", can + 0x18, 0x0000_0007, 0),
        register(CAN_BTR, can + 0x1C, ALL, BitTiming::solve(rate, APB1_HZ).map_or(0, btr)),
        register("CAN_FMR", filters + 0x200, 1, 0),
        register("CAN_FM1R", filters + 0x204, 0x0FFF_FFFF, 0b01 << first),
        register("CAN_FS1R", filters + 0x20C, 0x0FFF_FFFF, 0),
        register("CAN_FFA1R", filters + 0x214, 0x0FFF_FFFF, 0),
        register("CAN_FA1R", filters + 0x21C, 0x0FFF_FFFF, 0b01 << first),
        register("first bank, R1", bank, ALL, pair(lss::REQUEST_COB_ID, nmt::COMMAND_COB_ID)),
        register("first bank, R2", bank + 4, ALL, pair(sdo, lss::REQUEST_COB_ID)),
    ]
}

/// The value of CAN_BTR in normal mode (RM0090, 32.9.2).
fn btr(timing: BitTiming) -> u32 {
    (u32::from(timing.sync_jump_width) - 1) << 24
        | (u32::from(timing.segment2) - 1) << 20
        | (u32::from(timing.segment1) - 1) << 16
        | (u32::from(timing.prescaler) - 1)
}

impl Register {
    /// A value in words, where that helps.
    pub fn explain(&self, value: u32) -> String {
        match self.name {
            CAN_BTR => {}
            IDCODE => {
                let (device, revision) = (value & 0xFFF, value >> 16);
                let prefetch = match (device, revision) {
                    (0x413, 0x1000) => ": its prefetch is faulty (docs/product.md, \"Old chips\")",
                    _ => "",
                };
                return format!("device {device:03X}, revision {revision:04X}{prefetch}");
            }
            F_SIZE => return format!("{} KB", value >> 16),
            OPTCR => {
                let level = ["3", "2", "1", "off"][value as usize >> 2 & 3];
                return format!("{value:08X} (brown-out reset: {level})");
            }
            CSR if value & 1 << 2 != 0 => {
                return format!("{value:08X} (supply below 3.0 V: the flash is written by bytes)");
            }
            CSR => return format!("{value:08X} (supply above 2.75 V)"),
            _ => return format!("{:08X}", value & self.mask),
        }
        let segment1 = (value >> 16 & 0xF) + 1;
        let quanta = 1 + segment1 + (value >> 20 & 7) + 1;
        let prescaler = (value & 0x3FF) + 1;
        let mode = match value >> 30 {
            0 => "",
            1 => ", loop back",
            2 => ", silent",
            _ => ", loop back and silent",
        };
        format!(
            "{value:08X} ({} kbit/s, sample point {} %{mode})",
            APB1_HZ / 1000 / (prescaler * quanta),
            100 * (1 + segment1) / quanta
        )
    }
}

#[cfg(test)]
mod tests {
    use emulator::{
        Time,
        board::{Board, Settings},
        chip::{Access, Part, Width},
    };
    use testkit::{
        image,
        image_rig::{ImageRig, SETTINGS_OFFSET, flash_with, settings},
        product,
    };

    use super::*;

    #[test]
    fn the_table_has_the_values_of_the_emulated_board_on_can1_and_on_can2() {
        let on_can2 = product::build(Part::Stm32f405, 2).expect("it builds");
        let chip = chip();
        let mut differences = Vec::new();
        for (rate, id) in BitRate::ALL.into_iter().zip([1, 5, 0x7E].into_iter().cycle()) {
            for (controller, image) in [(1, image::image()), (2, &on_can2)] {
                let settings = settings(id, rate);
                let mut board = Board::new(
                    Part::Stm32f405,
                    image,
                    Settings { controller: controller.into(), ..Default::default() },
                );
                board.set_flash(SETTINGS_OFFSET, &flash_with(&[settings]));
                let mut rig = ImageRig::new(rate, [board]);
                rig.network.run_for(Time::from_ms(500));
                let id = NodeId::new(id).expect("1..=127");
                for register in expected(rate, id, controller, &chip) {
                    let board = rig.network.board(0);
                    let access = Access {
                        address: register.address,
                        width: Width::Word,
                        now: board.now(),
                        pc: 0,
                    };
                    let value = board.chip().read(access).expect("a register");
                    if value & register.mask != register.value {
                        let value = register.explain(value);
                        differences
                            .push(format!("CAN{controller} {rate:?} {}: {value}", register.name));
                    }
                }
            }
        }
        assert!(differences.is_empty(), "{differences:#?}");
    }

    fn chip() -> Chip {
        Chip::named(Part::Stm32f405.name()).expect("a chip")
    }

    #[test]
    fn size_options_revision_supply_and_bit_timing_are_shown_in_words() {
        let id = NodeId::new(1).expect("1..=127");
        let table = expected(BitRate::Kbit125, id, 1, &chip());
        for (name, value, words) in [
            (IDCODE, 0x1007_0413, "device 413, revision 1007"),
            (F_SIZE, 0x0400_ABCD, "1024 KB"),
            (OPTCR, 0x0FFF_AAED, "0FFFAAED (brown-out reset: off)"),
            (OPTCR, 0x0FFF_AAE1, "0FFFAAE1 (brown-out reset: 3)"),
            (CSR, 0x4000, "00004000 (supply above 2.75 V)"),
            (CSR, 0x4004, "00004004 (supply below 3.0 V: the flash is written by bytes)"),
            (CAN_BTR, 0x022F_000F, "022F000F (125 kbit/s, sample point 85 %)"),
            (CAN_BTR, 0x8049_000F, "8049000F (156 kbit/s, sample point 68 %, silent)"),
        ] {
            let register =
                table.iter().find(|register| register.name == name).expect("it is there");
            assert_eq!(register.explain(value), words);
        }
    }
}
