//! A product with an identity of its own: all sessions by its data sheet, or by its vendor-ID and product code.

use std::{fs, path::PathBuf, sync::LazyLock};

use emulator::chip::Part;
use testkit::{
    cargo::{cargo, scratch, workspace},
    emulated::Emulated,
    product,
};

use crate::run::{self, Run};

/// The program of a product that lacks two bit rates, automatic detection and the rescue, and its data sheet.
static DOOR: LazyLock<[PathBuf; 2]> = LazyLock::new(|| {
    let device = |from, to| ("src/device.rs", from, to);
    let changes = [
        device("vendor_id: 0x0000_0000", "vendor_id: 0x0000_01A2"),
        device("product_code: 0x0000_0001", "product_code: 0x0000_0D00"),
        device("revision_number: 0x0001_0000", "revision_number: 0x0002_0003"),
        device(
            "BitRates::possible(APB1_HZ).with_automatic()",
            "BitRates::possible(APB1_HZ).without(BitRate::Kbit1000).without(BitRate::Kbit10)",
        ),
        device(".with_rescue(true)", ".with_rescue(false)"),
    ];
    let elf = product::build_changed("door", Part::Stm32f446, 1, &changes);
    let path = scratch("door.elf");
    fs::write(&path, elf.unwrap_or_else(|error| panic!("{error}"))).expect("it can be written");
    let folder = workspace().join("target/products/door");
    let status = cargo()
        .current_dir(&folder)
        .args(["run", "--quiet", "--example", "eds", "--target-dir"])
        .arg(workspace().join("target"))
        .status();
    assert!(status.is_ok_and(|status| status.success()), "no data sheet");
    [path, folder.join("door.eds")]
});

/// Runs sessions on the product, as node 5 or as a new board.
fn run(name: &str, arguments: &[&str]) -> Run {
    let [program, _] = &*DOOR;
    let program = program.to_string_lossy();
    let boards = Emulated::start(&["--boards", "0", "--chip", "stm32f446", "--elf", &program]);
    run::run(name, &boards.adapter(), arguments)
}

#[test]
fn a_product_passes_all_sessions_by_its_data_sheet() {
    let [_, data_sheet] = &*DOOR;
    let run = run("door", &["--eds", &data_sheet.to_string_lossy(), "--without", "rescue"]);
    run.assert_good();
    for line in [
        ": vendor-ID: 000001A2 by LSS, 000001A2 by SDO",
        ": device name: door",
        "passed  bit rates that LSS accepts: 800, 500, 250, 125, 50, 20 kbit/s",
        "not tried  1000 kbit/s: the product does not offer it",
        "not tried  detection: the product does not offer it",
        "not tried  rescue: the product is without it",
        "passed  250 kbit/s by store and reset",
    ] {
        assert!(run.output.contains(line), "{line}");
    }
}

#[test]
fn a_product_passes_by_its_vendor_id_and_product_code() {
    let identity = ["--vendor-id", "0x1A2", "--product-code", "0xD00"];
    let sessions = ["--session", "sdo", "--session", "store"];
    let run = run("door-identity", &[&identity[..], &sessions].concat());
    run.assert_good();
    assert!(run.output.contains("1018h sub 0: 00000004"));
}

#[test]
fn a_product_is_left_alone_without_its_identity_or_with_another_one() {
    let own = workspace().join("eds/lss-slave.eds");
    let own = own.to_string_lossy();
    let [_, data_sheet] = &*DOOR;
    for (name, arguments, source) in [
        ("door-unknown", &[][..], "this firmware (src/device.rs)"),
        ("door-other", &["--eds", &own], &*own),
    ] {
        let run = run(name, arguments);
        run.assert_named("has vendor-ID 000001A2 and product code 00000D00, but ");
        run.assert_named(source);
        run.assert_left("untouched");
    }
    let sheet = fs::read_to_string(data_sheet).expect("it was written");
    let wrong = scratch("wrong.eds");
    fs::write(&wrong, sheet.replace("=door\n", "=gate\n")).expect("it can be written");
    run("door-wrong", &["--eds", &wrong.to_string_lossy(), "--session", "sdo"])
        .assert_named(": device name: door");
}

#[test]
fn half_of_an_identity_is_refused() {
    for (arguments, words) in [
        (&["--vendor-id", "1"][..], "--vendor-id and --product-code belong together"),
        (&["--eds", "no/such.eds"], "cannot read no/such.eds"),
    ] {
        let folder = crate::folder::new_folder("door-half");
        let output = run::command(&folder, "socketcan:none0", arguments).output().expect("it runs");
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(!output.status.success() && text.contains(words), "{text}");
    }
}
