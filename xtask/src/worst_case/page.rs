//! The tables of docs/worst-case.md.

use std::fmt::Write as _;

use super::{
    Analysis,
    costs::Costs,
    instruction::Mask,
    measure::Work,
    path::is_copy,
    response::{BIT, Stream, answer, bits, blocking, heartbeat, longest_blocking},
};

fn us(cycles: u64) -> String {
    format!("{:.1}", cycles as f64 / BIT as f64)
}

fn ratio(bound: u64, measured: u64) -> String {
    format!("{:.1}", bound as f64 / measured.max(1) as f64)
}

/// The blocks of the page with numbers, by name.
pub fn blocks(analysis: &Analysis) -> Vec<(&'static str, String)> {
    vec![
        ("tasks", tasks(analysis)),
        ("parts", parts(analysis)),
        ("blocking", blockings(analysis)),
        ("response", response(analysis)),
        ("answer", answers(analysis)),
        ("stack", stack(analysis)),
        ("loops", loops(analysis)),
    ]
}

fn tasks(analysis: &Analysis) -> String {
    let mut table =
        "| activation | bound | measured | ratio | with flash waits: bound | measured | ratio | \
                     chip: bound, us |\n|---|---|---|---|---|---|---|---|\n"
            .to_owned();
    let [core, flash, chip] = &analysis.costs;
    for (work, [without, with]) in &analysis.activations {
        let (Some(core), Some(flash), Some(chip)) = (
            core.of(&analysis.program, *work),
            flash.of(&analysis.program, *work),
            chip.of(&analysis.program, *work),
        ) else {
            continue;
        };
        let Work { task, frames, actions } = *work;
        let name = analysis.program.name(task);
        // The roll call, which finds no frame.
        if name == "CAN1_RX0" && frames == 0 {
            continue;
        }
        let plural = |number: u64, what: &str| match number {
            0 => String::new(),
            1 => format!(", 1 {what}"),
            _ => format!(", {number} {what}s"),
        };
        let _ = writeln!(
            table,
            "| {name}{}{} | {core} | {without} | {} | {flash} | {with} | {} | {} |",
            plural(frames, "frame"),
            plural(actions, "action"),
            ratio(core, *without),
            ratio(flash, *with),
            us(chip),
        );
    }
    table
}

fn parts(analysis: &Analysis) -> String {
    let [core, flash, chip] = &analysis.costs;
    let mut table =
        "| part | core | with flash waits | chip | chip, us |\n|---|---|---|---|---|\n".to_owned();
    type Part = fn(&Costs) -> u64;
    let parts: [(&str, Part); 11] = [
        ("C_frame, a further frame in an activation that LSS answers", |costs| costs.more_frames),
        ("C_silent, any other further frame", Costs::more_silent_frames),
        ("C_action, an action", |costs| costs.action),
        ("C_beat, a heartbeat", heartbeat),
        ("C_tx, CAN1_TX", |costs| costs.transmitted),
        ("C_status, CAN1_SCE", |costs| costs.status),
        ("C_due, TIM2", |costs| costs.due),
        ("C_release, from the interrupt to the release of the first frame", |costs| costs.release),
        ("C_answer, from the interrupt to the transmit request of an LSS answer", |costs| {
            costs.answer
        }),
        (
            "Outside of service: a change of the bit rate, and the controller does not respond",
            |costs| costs.start,
        ),
        ("Outside of service: a frame of the node, and the transmit queue is full", |costs| {
            costs.transmit
        }),
    ];
    for (name, part) in parts {
        let _ = writeln!(
            table,
            "| {name} | {} | {} | {} | {} |",
            part(core),
            part(flash),
            part(chip),
            us(part(chip))
        );
    }
    table
}

fn blockings(analysis: &Analysis) -> String {
    let mut table =
        "| under way | core, us | measured | with flash waits, us | measured | chip, us |\n\
                     |---|---|---|---|---|---|\n"
            .to_owned();
    let [core, flash, chip] = analysis.costs.each_ref().map(blocking);
    let [without, with] = analysis.measured.each_ref().map(|measured| {
        let longest = |name: &str| {
            let tasks = measured.tasks.iter();
            let of = tasks.filter(|(work, _)| analysis.program.name(work.task) == name);
            of.map(|(_, longest)| longest.cycles).max()
        };
        let section = |mask: Mask| {
            let sections = measured.sections.iter();
            let of = sections.filter(|((at, _), _)| analysis.program.masks.get(at) == Some(&mask));
            of.map(|(_, cycles)| *cycles).max()
        };
        let (raised, disabled) = (section(Mask::Raise), section(Mask::Disable));
        [longest("TIM2"), longest("CAN1_SCE"), raised, disabled, None, None]
    });
    let measured = |cycles: Option<u64>| cycles.map_or(String::new(), us);
    for (number, core) in core.iter().enumerate() {
        let _ = writeln!(
            table,
            "| {} | {} | {} | {} | {} | {} |",
            core.name,
            us(core.cycles),
            measured(without[number]),
            us(flash[number].cycles),
            measured(with[number]),
            us(chip[number].cycles)
        );
    }
    for (name, with_store) in [("B, the longest", true), ("B without a store", false)] {
        let longest = analysis.costs.each_ref().map(|costs| longest_blocking(costs, with_store));
        let [core, flash, chip] = longest.map(us);
        let _ = writeln!(table, "| {name} | {core} | | {flash} | | {chip} |");
    }
    table
}

fn response(analysis: &Analysis) -> String {
    let mut table = "| | core | with flash waits | chip |\n|---|---|---|---|\n".to_owned();
    let first = |costs: &Costs, with_store| {
        longest_blocking(costs, with_store) + costs.transmitted + costs.release
    };
    for (name, with_store) in [("", true), (", without a store", false)] {
        let [core, flash, chip] =
            analysis.costs.each_ref().map(|costs| us(first(costs, with_store)));
        let _ = writeln!(table, "| B + C_tx + C_release, us{name} | {core} | {flash} | {chip} |");
    }
    table.push_str(
        "\n| frames without a gap | T, us | 3 T, us | C, us | first frame that may be lost | without a store |\n\
         |---|---|---|---|---|---|\n",
    );
    let mut heartbeat_ms = 0;
    for (name, costs) in ["core", "flash waits", "chip"].iter().zip(&analysis.costs) {
        for stream in Stream::all(costs) {
            let [loss, without_store] = [true, false].map(|with_store| {
                let blocking = longest_blocking(costs, with_store);
                heartbeat_ms = heartbeat_ms.max(stream.least_heartbeat_ms(costs, blocking));
                let loss = stream.first_loss(costs, blocking, None);
                loss.map_or("none".to_owned(), |loss| loss.to_string())
            });
            let _ = writeln!(
                table,
                "| {}, {name} | {} | {} | {} | {loss} | {without_store} |",
                stream.name,
                bits(stream.bytes),
                us(3 * stream.period()),
                us(stream.cycles),
            );
        }
    }
    let _ = writeln!(
        table,
        "\nNo row changes with heartbeats, if their producer heartbeat time is {heartbeat_ms} ms or more."
    );
    table
}

fn answers(analysis: &Analysis) -> String {
    let mut table =
        "| LSS answer, us | core | with flash waits | chip |\n|---|---|---|---|\n".to_owned();
    let [core, flash, chip] = &analysis.costs;
    let mut row = |name: &str, [core, flash, chip]: [String; 3]| {
        let _ = writeln!(table, "| {name} | {core} | {flash} | {chip} |");
    };
    let costs = [core, flash, chip];
    row("nothing else to do: C_answer", costs.map(|costs| us(costs.answer)));
    let [without, with] = analysis.measured.each_ref().map(|measured| measured.answer);
    row("measured", [us(without), us(with), String::new()]);
    row("ratio", [ratio(core.answer, without), ratio(flash.answer, with), String::new()]);
    row("B + 2 C_tx + C_answer", costs.map(|costs| us(answer(costs, 0))));
    for before in 0..Stream::all(core).len() {
        let stream = Stream::all(core)[before];
        let sums = costs.map(|costs| us(answer(costs, 2 * Stream::all(costs)[before].cycles)));
        row(&format!("behind two {}: + 2 C", stream.name), sums);
    }
    table
}

fn stack(analysis: &Analysis) -> String {
    let mut table = "| level | bytes | measured |\n|---|---|---|\n".to_owned();
    for (name, bytes, measured) in &analysis.levels {
        let measured = measured.map_or(String::new(), |bytes| bytes.to_string());
        let _ = writeln!(table, "| {name} | {bytes} | {measured} |");
    }
    let bound: u32 = analysis.levels.iter().map(|(_, bytes, _)| bytes).sum();
    let measured = analysis.stack;
    let _ = writeln!(table, "| sum | {bound} | {measured} |");
    let ratio = ratio(bound.into(), measured.into());
    let _ = writeln!(table, "\nThe ratio is {ratio}. The stack has {} bytes.", analysis.stack_size);
    table
}

fn loops(analysis: &Analysis) -> String {
    let mut table =
        "| function | loop | rounds | measured | reason |\n|---|---|---|---|---|\n".to_owned();
    for found in analysis.loops.iter().filter(|found| !is_copy(&found.place)) {
        let name = analysis.program.name(found.function);
        let line = if found.text.is_empty() { &found.place } else { &found.text };
        let line = line.replace('|', "\\|");
        let measured =
            analysis.back.get(&found.header).map_or("-".to_owned(), |back| back.to_string());
        let _ = writeln!(
            table,
            "| `{}` | `{line}` | {} | {measured} | {} |",
            name.replace("lss_slave::", ""),
            found.rounds,
            found.reason
        );
    }
    table
}

/// Replaces the content between the markers of each block: `<!-- tasks -->` and `<!-- end of tasks -->`.
pub fn fill(page: &str, blocks: &[(&str, String)]) -> Option<String> {
    let mut page = page.to_owned();
    for (name, content) in blocks {
        let (begin, end) = (format!("<!-- {name} -->\n"), format!("<!-- end of {name} -->"));
        let from = page.find(&begin)? + begin.len();
        let to = from + page[from..].find(&end)?;
        page.replace_range(from..to, content);
    }
    Some(page)
}

/// Whether two pages are equal but for numbers that differ by less than a twentieth.
pub fn is_close(found: &str, expected: &str) -> bool {
    let (mut found, mut expected) = (pieces(found), pieces(expected));
    loop {
        match (found.next(), expected.next()) {
            (None, None) => return true,
            (Some(a), Some(b)) => {
                let are_close = match (a.parse::<f64>(), b.parse::<f64>()) {
                    (Ok(a), Ok(b)) => (a - b).abs() <= b / 20.0,
                    _ => a == b,
                };
                if !are_close {
                    return false;
                }
            }
            _ => return false,
        }
    }
}

/// Numbers, and the text between them.
fn pieces(text: &str) -> impl Iterator<Item = &str> {
    let mut rest = text;
    std::iter::from_fn(move || {
        let is_number = rest.chars().next()?.is_ascii_digit();
        let end = rest.find(|c: char| (c.is_ascii_digit() || is_number && c == '.') != is_number);
        let (piece, after) = rest.split_at(end.unwrap_or(rest.len()));
        rest = after;
        Some(piece)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_may_differ_a_little_and_words_not_at_all() {
        assert!(is_close("| C | 1000 | 12.5 |", "| C | 1040 | 12.9 |"));
        assert!(!is_close("| C | 1000 |", "| C | 1100 |"));
        assert!(!is_close("| C | 1000 |", "| B | 1000 |"));
        assert!(!is_close("| C | 1000 |", "| C | 1000 | 1 |"));
    }

    #[test]
    fn a_block_is_filled_between_its_markers() {
        let page = "a\n<!-- x -->\nold\n<!-- end of x -->\nb\n";
        let filled = fill(page, &[("x", "new\n".to_owned())]).expect("the markers");
        assert_eq!(filled, "a\n<!-- x -->\nnew\n<!-- end of x -->\nb\n");
        assert_eq!(fill(page, &[("y", String::new())]), None);
    }
}
