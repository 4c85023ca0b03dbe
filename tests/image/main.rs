//! Tests of the release image on emulated boards, in virtual time.

mod answer_time;
mod bad_input;
mod block_transfer;
mod can_traps;
mod chip_traps;
mod chips;
mod commissioning;
mod controllers;
mod damaged_log;
mod do_no_harm;
mod halted;
mod indicators;
mod io;
mod medium_faults;
mod node_id;
mod overload;
mod power_cut;
mod product;
mod rare_moments;
mod rare_searches;
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
const FIRMWARE: testkit::image::Firmware = testkit::image::Firmware::Default;
