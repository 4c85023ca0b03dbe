//! The tests of what the example `io` has in common with the firmware as it is, but times and sizes, on its image.

mod can_traps;
mod chip_traps;
mod commissioning;
mod halted;
mod medium_faults;
mod node_id;
mod overload;
mod power_cut;
mod rare_moments;
mod rare_searches;
mod rates_bus_off;
mod rates_detection;
mod rig;
mod robustness;
mod uptime;

/// The image under test.
const FIRMWARE: testkit::image::Firmware = testkit::image::Firmware::Io;
