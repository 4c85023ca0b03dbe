//! The report on peripherals that the emulator does not model: a line for each function and register.

use std::collections::BTreeMap;

use emulator::{board::Board, image::Image};

/// A line for each register that is not modelled and each function of the program that uses it.
pub fn report(board: &Board) -> Vec<String> {
    let chip = board.chip();
    let mut uses = BTreeMap::<(u32, String), (u64, bool)>::new();
    for finding in chip.findings().iter().filter(|finding| chip.is_tolerable(finding)) {
        let function = function_at(board.image(), finding.pc);
        let (count, is_written) = uses.entry((finding.address & !3, function)).or_default();
        *count += finding.count;
        *is_written |= finding.write;
    }
    let line = |((address, function), (count, is_written)): ((u32, _), (u64, bool))| {
        let register = chip.register_name(address);
        let done = if is_written { "used" } else { "read" };
        let times = if count == 1 { "once".to_owned() } else { format!("{count} times") };
        format!("not modelled: {register}, {done} {times} by {function}")
    };
    uses.into_iter().map(line).collect()
}

/// The name of the function at an address of a program.
pub fn function_at(image: &Image, address: u32) -> String {
    match image.symbol_at(address) {
        Some((name, _)) => format!("{:#}", rustc_demangle::demangle(name)),
        None => format!("{address:08x}"),
    }
}
