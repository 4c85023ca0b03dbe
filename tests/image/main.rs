//! Tests of the release image on emulated boards, in virtual time.

mod answer_time;
mod bad_input;
mod bit_rate;
mod can_traps;
mod chip_traps;
mod commissioning;
mod do_no_harm;
mod eds;
mod errors;
mod indicators;
mod io;
mod medium_faults;
mod node_id;
mod overload;
mod power_cut;
mod rates_bus_off;
mod rates_detection;
mod rates_matrix;
mod rates_rescue;
mod robustness;
mod session;
mod sleep;
mod stack;
mod storm;
mod switch_delay;
mod uptime;
