//! The registers of the first board, read by the probe and compared with those of the emulated board.

use crate::{bench::Bench, registers, stop::Stop};

pub fn run(bench: &mut Bench) -> Result<(), Stop> {
    let Some(probe) = &bench.probe else {
        bench.report.not_tried("registers", "no --probe");
        return Ok(());
    };
    let expected =
        registers::expected(bench.base, bench.boards[0].id, probe.controller, &probe.chip);
    bench.report.progress("reading registers with probe-rs");
    for register in expected {
        match probe.read(register.address) {
            Err(why) => {
                bench.report.not_tried("registers", why);
                return Ok(());
            }
            Ok(value) => bench.report.expect(
                register.name,
                value & register.mask == register.value,
                register.explain(value),
                register.explain(register.value),
            ),
        };
    }
    Ok(())
}
