//! Registers that are not modelled.

use emulator::chip::{Part, Problem, ResetCause, Width};

use crate::rig::{RCC_APB1ENR, RCC_CR, Rig};

const DAC_CR: u32 = 0x4000_7400;
const DMA2_S0CR: u32 = 0x4002_6410;
const TIM2_SMCR: u32 = 0x4000_0008;

#[test]
fn a_register_that_is_not_modelled_reads_as_it_was_written() {
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(RCC_APB1ENR, 1);
    for register in [DAC_CR, DMA2_S0CR, TIM2_SMCR] {
        rig.write(register, 0x1234);
        assert_eq!(rig.read(register), 0x1234, "{register:08x}");
        rig.store(register, Width::Half, 0x50).expect("no bus error");
        assert_eq!(rig.load(register, Width::Half), 0x50, "{register:08x}");
    }
    assert!(rig.problems().iter().all(|problem| *problem == Problem::Unmodelled));
    rig.reset_by_rcc(1);
    assert_eq!((rig.read(TIM2_SMCR), rig.read(DAC_CR)), (0, 0x50_0050), "TIM2 alone is reset");
    rig.reset_now(ResetCause::Software);
    assert_eq!(rig.read(DAC_CR), 0);
}

#[test]
fn a_register_of_rcc_that_is_not_modelled_does_not_read_back() {
    const RCC_RESERVED: u32 = RCC_CR + 0xFC;
    let mut rig = Rig::new(Part::Stm32f405);
    rig.write(RCC_RESERVED, 1);
    assert_eq!((rig.read(RCC_RESERVED), rig.problems().len()), (0, 2));
}

#[test]
fn registers_have_the_names_of_the_manual() {
    let rig = Rig::new(Part::Stm32f405);
    for (address, name) in [
        (DAC_CR, "DAC, offset 00h"),
        (0x4000_5408, "I2C1, offset 08h"),
        (0x4001_2004, "ADC, offset 04h"),
        (DMA2_S0CR, "DMA2, offset 10h"),
        (0x5000_0808, "OTG_FS, offset 808h"),
        (0x4001_2404, "40012404h"),
    ] {
        assert_eq!(rig.register_name(address), name);
    }
}
