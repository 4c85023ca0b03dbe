//! The CAN controller of a board, as an argument of the commands.

use anyhow::ensure;
use emulator::chip::Part;

/// Checks that the chip has the CAN controller.
///
/// # Errors
/// It does not; the message names the chips that do.
pub fn check(chip: Part, controller: u8) -> anyhow::Result<()> {
    let has = |part: &Part| usize::from(controller) <= part.cans();
    let having = || Part::F4.into_iter().filter(has).map(Part::name).collect::<Vec<_>>();
    ensure!(
        has(&chip),
        "{} has no CAN{controller}, only {} have",
        chip.name(),
        having().join(" and ")
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chip_without_the_can_controller_is_refused() {
        check(Part::Stm32f405, 2).expect("every chip has CAN2");
        check(Part::Stm32f423, 3).expect("an STM32F423 has CAN3");
        let error = check(Part::Stm32f446, 3).expect_err("no CAN3").to_string();
        assert_eq!(error, "stm32f446 has no CAN3, only stm32f413 and stm32f423 have");
    }
}
