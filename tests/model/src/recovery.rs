//! The way back: a master that looks for every board at each bit rate, on a network without further faults.

use testkit::frames::{number, request};

use crate::{
    board::RATES,
    master::{Master, Task},
    network::Network,
};

/// The time that the master spends at one bit rate: the 30 s for which the supervision trusts a switch, and the 10 s in
/// which it finds the others.
const AT_EACH_RATE_MS: u32 = 40_000;
/// The pause after each question.
const PAUSE_MS: u32 = 50;
/// The time after which a controller gives a frame up.
const SEND_MS: u32 = 1_220;

/// The boards that no master finds: with power for all of them, it selects each by its LSS address, at each bit rate.
pub fn lost(mut network: Network) -> Vec<usize> {
    for board in &mut network.boards {
        board.end_store(Ok(()));
        if board.running.is_none() {
            board.power_on();
        }
    }
    network.exchange();
    let mut lost: Vec<usize> = (0..network.boards.len()).collect();
    for rate in RATES {
        network.master = Master::new(rate);
        let mut left_ms = AT_EACH_RATE_MS;
        while left_ms > 0 && !lost.is_empty() {
            lost.retain(|&board| {
                let is_found = answers(&mut network, board);
                let took_ms = if is_found == Some(true) { 0 } else { PAUSE_MS };
                left_ms =
                    left_ms.saturating_sub(if is_found.is_none() { SEND_MS } else { took_ms });
                is_found != Some(true)
            });
        }
    }
    lost
}

/// Whether a board answers switch state selective; `None` if a request does not get through.
fn answers(network: &mut Network, board: usize) -> Option<bool> {
    let address = network.boards[board].address();
    network.master.task = Task::Idle;
    let parts =
        [address.vendor_id, address.product_code, address.revision_number, address.serial_number];
    let requests = ["40", "41", "42", "43"].into_iter().zip(parts);
    let requests = requests.map(|(command, part)| request(&format!("{command} {}", number(part))));
    for frame in [request("04 00")].into_iter().chain(requests) {
        // An answer to an earlier master may still wait.
        while (0..network.boards.len()).any(|board| network.answer(board, false).is_some()) {}
        if !network.send(&frame, None) {
            return None;
        }
    }
    let answer = network.answer(board, true);
    network.pass(PAUSE_MS * 1000);
    Some(answer.is_some_and(|answer| answer.data()[0] == 0x44))
}
