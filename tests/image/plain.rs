//! The tests of plain behaviour, on the image without bit-rate supervision: all but those of the search, those of the
//! example, and those that build images of their own.

mod answer_time;
mod bad_input;
mod can_traps;
mod chip_traps;
mod commissioning;
mod controllers;
mod halted;
mod indicators;
mod medium_faults;
mod node_id;
mod overload;
mod power_cut;
mod rare_moments;
mod rates_bus_off;
mod rates_detection;
mod rates_matrix;
mod rig;
mod robustness;
mod sleep;
mod stack;
mod storm;
mod switch_delay;
mod uptime;

/// The image under test.
const FIRMWARE: testkit::image::Firmware = testkit::image::Firmware::Plain;
