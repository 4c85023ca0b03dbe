//! Power cuts at any two words, with cells that read differently at each start.

use std::env;

use testkit::random::Random;

use crate::{
    device::{Cut, Device, Runs},
    flash::Chip,
    program::file,
};

/// What the client does after a cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Client {
    /// It starts again until the new program is confirmed.
    Retries,
    /// It is gone.
    Leaves,
}

/// What becomes of the trial.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Trial {
    Confirmed,
    /// Three starts, then the old program.
    Fails,
}

/// The programs that may count in the end.
#[derive(Debug)]
struct May {
    be: Vec<usize>,
}

/// The client updates the device to `to`.
fn update(device: &mut Device, to: usize, trial: Trial, may: &mut May) -> Result<(), Cut> {
    let mut has_failed = false;
    for _ in 0..10 {
        match device.start()? {
            Runs::Program(_) if device.number() == to => {
                if trial == Trial::Fails {
                    has_failed = true;
                    continue;
                }
                may.be.push(to);
                if device.confirm()?.is_ok() {
                    may.be = vec![to];
                    return Ok(());
                }
            }
            Runs::Program(_) => {
                if has_failed {
                    return Ok(());
                }
                let mut loader = device.stop()?;
                let _ = device.update(&mut loader, to)?;
            }
            Runs::Loader(mut loader) => {
                let _ = device.work(&mut loader)?;
            }
        }
    }
    Ok(())
}

/// A device that has taken `updates` updates, which now has two cuts.
fn story(
    first: usize,
    second: usize,
    client: Client,
    trial: Trial,
    again: bool,
    seed: u64,
) -> usize {
    let files: Vec<_> = (0..3).map(|number| file(number, 20)).collect();
    let mut device = Device::new(Chip::with(&files[0], seed), files);
    let mut may = May { be: vec![0] };
    let mut to = 1;
    if again {
        update(&mut device, to, Trial::Confirmed, &mut may).expect("the power is on");
        assert_eq!(may.be, [1]);
        to = 2;
    }
    device.chip.0.borrow_mut().operations.clear();
    let mut taken = 0;
    for cut in [Some(first), Some(second), None] {
        device.chip.cut_after(cut);
        let is_gone = cut != Some(first) && client == Client::Leaves;
        let outcome = if is_gone {
            device.alone().map(|_| ())
        } else {
            update(&mut device, to, trial, &mut may)
        };
        if cut == Some(first) && outcome.is_ok() {
            taken = device.chip.operations();
        }
        device.power_on();
    }
    device.chip.cut_after(None);
    let number = device.alone().expect("the power is on");
    assert!(may.be.contains(&number), "program {number} runs, {may:?}");
    if client == Client::Retries && trial == Trial::Confirmed {
        assert_eq!(number, to, "the client has not updated it");
    }
    taken
}

#[test]
fn after_cuts_at_any_two_words_the_old_or_the_new_program_runs() {
    let mut random = Random::from_environment();
    let step = env::var("STEP").map_or(151, |text| text.parse().expect("a number"));
    let mut runs = 0;
    for client in [Client::Retries, Client::Leaves] {
        for trial in [Trial::Confirmed, Trial::Fails] {
            for again in [false, true] {
                let operations = story(10_000, 10_000, client, trial, again, 0);
                assert!(operations >= 270, "{operations} operations");
                for first in 0..operations {
                    let start = random.within(0..step) as usize;
                    for second in (start..operations).step_by(step as usize) {
                        let seed = random.u64();
                        let run = move || story(first, second, client, trial, again, seed);
                        if std::panic::catch_unwind(run).is_err() {
                            panic!("{client:?}, {trial:?}, {again}: {first}, {second}, {seed}");
                        }
                        runs += 1;
                    }
                }
            }
        }
    }
    println!("{runs} runs");
}
