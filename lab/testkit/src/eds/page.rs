//! The page of the objects for people, in Markdown.

use canopen_node::emergency::OwnCode;

use super::{DataSheet, Value, access, is_record, line};

impl DataSheet<'_> {
    /// The page, with a line for each value.
    pub fn page(&self) -> String {
        let mut page = format!(
            "\
# Object dictionary

The objects of {}, in one line for each value. `cargo xtask eds` makes this page and
[`{}`](../eds/{}) from the tables of the firmware: change those instead.

| object | sub | name | type | access | default | limits | |
|---|---|---|---|---|---|---|---|
",
            self.product.device.name, self.product.file_name, self.product.file_name,
        );
        for values in self.objects() {
            let index = values[0].entry.index;
            if let Some(name) = values[0].description.object {
                let kind = if is_record(values) { "RECORD" } else { "ARRAY" };
                line(&mut page, format_args!("| {index:04X}h | | **{name}** | {kind} | | | | |"));
            }
            for value in values {
                line(&mut page, row(value));
            }
        }
        page + "\n" + &emergencies()
    }
}

/// The table of the node's own emergency messages.
fn emergencies() -> String {
    let mut table = "\
## Emergency messages

The node sends these itself; `report` refuses their codes. Error code 0000h follows when no error is left. Each bit of
the register stays in 1001h until its error ends.

| code | cause | register | bytes 3 to 7 | ends when |
|---|---|---|---|---|
"
    .to_owned();
    for OwnCode { code, register, cause, information, end } in OwnCode::ALL {
        let information = if information.is_empty() { "0" } else { information };
        let cells =
            format_args!("| {code:04X}h | {cause} | {register:02X}h | {information} | {end} |");
        line(&mut table, cells);
    }
    table
}

fn row(value: &Value) -> String {
    let Value { entry, description, default } = value;
    let options = [
        (entry.options.is_mappable(), "mappable"),
        (entry.options.is_quiet(), "quiet"),
        (entry.options.is_stored(), "stored"),
    ];
    let options: Vec<_> =
        options.iter().filter(|(applies, _)| *applies).map(|(_, name)| *name).collect();
    let cells = [
        format!("{:04X}h", entry.index),
        entry.sub_index.to_string(),
        description.name.to_string(),
        data_type(value),
        access(entry).to_owned(),
        default.clone().unwrap_or_default(),
        description.limits.map_or_else(String::new, |(low, high)| format!("{low} to {high}")),
        options.join(", "),
    ];
    let cell = |text: String| {
        if text.is_empty() { " |".into() } else { format!(" {} |", text.replace('|', "\\|")) }
    };
    format!("|{}", cells.map(cell).concat())
}

/// The data type as CiA 301 writes it, such as `UNSIGNED8` and `VISIBLE_STRING`.
fn data_type(value: &Value) -> String {
    format!("{:?}", value.entry.data_type).replace("String", "_String").to_uppercase()
}
