//! Wrong declarations of objects and PDOs: `cargo check` names each, with the object or the PDO.

use std::{fmt::Write as _, fs};

use testkit::cargo::{cargo, scratch, workspace};

/// Beside the wrong part: an input, an output, and a value that is not mappable.
const VALUES: &str = r#"0x6000 "Values" {
    1 "Input" input: u64 = 0, ro, mappable;
    2 "Output" output: u8 = 0, wo, mappable;
    3 "Private" private: u8 = 0, rw;
}"#;

/// Objects that are wrong, each followed by the message.
const OBJECTS: &str = r#"
0x2000 { 0 "A" a: u8 = 0, rw; }
    object 2000h sub-index 0: its index must be 2001h to 9FFFh
0x2FF0 { 0 "A" a: u8 = 0, rw; }
    object 2FF0h sub-index 0: this index is that of the node-ID and the bit rate: take another
0x2101 { 0 "A" a: u8 = 0, rw; } 0x2100 { 0 "B" b: u8 = 0, rw; }
    object 2100h sub-index 0: objects must be sorted by index and sub-index
0x2100 "A" { 2 "A" a: u8 = 0, rw; 1 "B" b: u8 = 0, rw; }
    object 2100h sub-index 1: objects must be sorted by index and sub-index
0x2100 { 0 "A" a: u8 = 0, rw; } 0x2100 { 0 "B" b: u8 = 0, rw; }
    object 2100h sub-index 0: it is declared twice
0x2100 "A" { 1 "A" a: u8 = 0, rw; 1 "B" b: u8 = 0, rw; }
    object 2100h sub-index 1: it is declared twice
0x2100 { 1 "A" a: u8 = 0, rw; }
    object 2100h sub-index 1: an object with sub-indices needs a name behind its index, and no sub-index 0, which is added
0x2100 { 0 "A" a: u8 = 0, rw; 1 "B" b: u8 = 0, rw; }
    object 2100h sub-index 1: an object with sub-indices needs a name behind its index, and no sub-index 0, which is added
0x2100 { 0 "A" a: u16 = 101, rw in 0..=100; }
    object 2100h sub-index 0: its default is out of its limits
0x2100 "A" { 1..=2 "A" a: [u16; 2] = [0, 101], rw in 0..=100; }
    object 2100h sub-index 2: its default is out of its limits
0x2100 { 0 "A" a: Unsigned24 = 0, rw in 0..=16_777_216; }
    object 2100h sub-index 0: a limit is out of the range of its type
0x2100 "A" { 1..=3 "A" a: [u16; 2] = [0; 2], rw; }
    object 2100h sub-index 1: an array has a value for each of its sub-indices, such as 1..=4 and [f32; 4]
0x2100 { 0 "A" a: &'static str = "", ro, mappable; }
    object 2100h sub-index 0: only numbers can be mapped into a PDO: leave `mappable` out
0x2100 { 0 "A" a: u8 = 0, ro, quiet; }
    object 2100h sub-index 0: only a mappable object can be quiet: add `mappable`
0x2100 { 0 "A" a: u8 = 0, constant, stored; }
    object 2100h sub-index 0: a constant is not stored: leave `stored` out
0x2100 { 0 "A" a: Domain = Domain, ro, stored; }
    object 2100h sub-index 0: what is read and written in parts is not stored: its application keeps it
0x2100 { 0 "A" a: u8 = 0, ro with read; }
    object 2100h sub-index 0: only a `Domain` or a `LongText` is declared `with` methods
0x2100 { 0 "A" a: Domain = Domain, rw with read; }
    object 2100h sub-index 0: a client can write it, so it needs two methods: `with read and write`
0x2100 { 0 "A" a: u8 = 0, r; }
    object 0x2100 sub-index 0: `r` is no access; there are constant, ro, rw, rwr, rww and wo
0x2100 { 0 "A" a: u8 = 0, rw, mapable; }
    object 0x2100 sub-index 0: `mapable` is no option; there are mappable, quiet and stored
0x2100 { 0 "A" a: usize = 0, rw; }
    `usize` is no type of an object
0x2100 { 0 "A" a: u8 = 256, rw; }
    literal out of range for `u8`
0x2100 { 0 "A" a: u8 = 0, rw; } 0x2101 { 0 "B" a: u8 = 0, rw; }
    field `a` is already declared
"#;

/// What is wrong beside the objects, each followed by the message.
const COMMUNICATION: &str = r#"
TPDOS: &'static [Tpdo] = &[Tpdo::UNUSED, Tpdo::new(&[(0x6000, 4)])];
    TPDO 2: 6000h sub-index 4 does not exist
TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 3)])];
    TPDO 1: 6000h sub-index 3 is not declared as mappable: add this option
TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 2)])];
    TPDO 1: 6000h sub-index 2 is no input: its access is wo or rww, and must be ro, rwr or rw
RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(0x6000, 1)])];
    RPDO 1: 6000h sub-index 1 is no output: its access is constant, ro or rwr, and must be wo, rww or rw
TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 1), (0x6000, 1)])];
    TPDO 1: its values have 16 bytes, at most 8 are possible
RPDOS: &'static [Rpdo] = &[Rpdo::new(&[(5, 0); 9])];
    RPDO 1: 9 values are mapped, at most 8 are possible
TPDOS: &'static [Tpdo] = &[Tpdo::UNUSED; 17];
    TPDO 17: a node has at most 16
RPDOS: &'static [Rpdo] = &[Rpdo::UNUSED; 17];
    RPDO 17: a node has at most 16
TPDOS: &'static [Tpdo] = &[Tpdo::new(&[]); 5];
    TPDO 5: it must be `invalid()`: only the first 4 have a COB-ID in a new device
TPDOS: &'static [Tpdo] = &[Tpdo::new(&[]).with_transmission_type(253)];
    TPDO 1: the transmission type must be 0 to 240, 254 or 255
RPDOS: &'static [Rpdo] = &[Rpdo::new(&[]).with_transmission_type(241)];
    RPDO 1: the transmission type must be 0 to 240, 254 or 255
RPDOS: &'static [Rpdo] = &{ let mut all = [Rpdo::UNUSED; 10]; all[9] = Rpdo::new(&[(6, 0); 3]); all };
    RPDO 10: it must be `invalid()`: only the first 4 have a COB-ID in a new device
TPDOS: &'static [Tpdo] = &[Tpdo::new(&[]).with_sync_start_value(241)];
    TPDO 1: the SYNC start value must be 0 to 240
PRODUCERS: usize = 17;
    PRODUCERS is 17, at most 16 are possible
WATCHED: &'static [(u8, u16)] = &[(1, 500)];
    WATCHED: node 1 is one more than PRODUCERS, which is 0
PRODUCERS: usize = 2; const WATCHED: &'static [(u8, u16)] = &[(1, 500), (1, 900)];
    WATCHED: node 1 is watched twice
PRODUCERS: usize = 1; const WATCHED: &'static [(u8, u16)] = &[(128, 500)];
    WATCHED: node 128 does not exist: node-IDs are 1 to 127
PRODUCERS: usize = 1; const WATCHED: &'static [(u8, u16)] = &[(1, 0)];
    WATCHED: node 1 needs a time of 1 to 65535 ms
PRODUCERS: usize = { canopen_node::error_code!(0xFF10); 0 };
    error code FF10h is the node's own: the node takes part at another bit rate
PRODUCERS: usize = { canopen_node::error_code!(0); 0 };
    error code 0000h is the node's own: no error is left
"#;

/// The declarations of a list and their messages.
fn pairs(list: &str) -> impl Iterator<Item = (&str, &str)> {
    let mut lines = list.trim().lines();
    std::iter::from_fn(move || Some((lines.next()?, lines.next().expect("a message").trim())))
}

/// A program with these objects and these constants of the application.
fn program(objects: &str, communication: &str) -> String {
    format!(
        "#![allow(unused_imports)]
use canopen_node::{{Application, application::*, objects, pdo::{{Rpdo, Tpdo}}}};
objects! {{ pub struct Objects, values Value; {objects} }}
impl Application for Objects {{ {communication} }}
#[allow(dead_code)]
impl Objects {{ fn read(&self) -> &[u8] {{ &[] }} }}
fn main() {{}}
"
    )
}

#[test]
fn each_wrong_declaration_is_named_by_cargo_check() {
    let of_objects = pairs(OBJECTS).map(|(objects, message)| (program(objects, ""), message));
    let of_communication = pairs(COMMUNICATION)
        .map(|(constants, message)| (program(VALUES, &format!("const {constants}")), message));
    let folder = scratch("wrong_declarations");
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir_all(folder.join("src")).unwrap();
    let library = workspace().join("libs/canopen-node");
    fs::write(
        folder.join("Cargo.toml"),
        format!(
            "[package]\nname = \"wrong\"\nedition = \"2024\"\n[workspace]\n\
             [dependencies]\ncanopen-node = {{ path = {library:?} }}\n"
        ),
    )
    .unwrap();
    fs::copy(workspace().join("Cargo.lock"), folder.join("Cargo.lock")).unwrap();
    let mut hidden: Vec<_> = of_objects.chain(of_communication).enumerate().collect();
    for (number, (program, _)) in &hidden {
        fs::write(folder.join(format!("src/wrong{number}.rs")), program).unwrap();
    }
    let right = program(
        VALUES,
        "const TPDOS: &'static [Tpdo] = &[Tpdo::new(&[(0x6000, 1)])];
         const PRODUCERS: usize = 2;
         const WATCHED: &'static [(u8, u16)] = &[(1, 500), (127, 900)];",
    );
    // The compiler checks in several passes, and an error in one hides those of the next ones: what it has named is
    // left out then, until the right program is left.
    loop {
        let modules: String =
            hidden.iter().map(|(number, _)| format!("mod wrong{number};\n")).collect();
        fs::write(folder.join("src/main.rs"), format!("{right}{modules}")).unwrap();
        let mut check = cargo();
        check.current_dir(&folder).env("CARGO_TARGET_DIR", scratch("wrong_declarations_target"));
        check.env("CARGO_INCREMENTAL", "0");
        check.args(["check", "--offline", "--message-format", "short"]);
        let said = String::from_utf8(check.output().unwrap().stderr).unwrap();
        let errors_of = |file: &str| {
            let place = format!("src/{file}.rs:");
            said.lines().filter(|line| line.contains(&place)).collect::<Vec<_>>().join("\n")
        };
        if hidden.is_empty() {
            assert_eq!(errors_of("main"), "", "{said}");
            assert!(said.contains("Finished"), "{said}");
            break;
        }
        let count = hidden.len();
        let mut faults = String::new();
        hidden.retain(|(number, (program, message))| {
            let errors = errors_of(&format!("wrong{number}"));
            let is_named = errors.contains(message);
            if !is_named {
                writeln!(faults, "{program}should say: {message}\nbut says: {errors}\n").unwrap();
            }
            !is_named
        });
        assert!(hidden.len() < count, "{faults}{said}");
    }
}
