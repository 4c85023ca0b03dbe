"""Reads the data sheets with programs of others: Lely's dcfchk and dcfgen, which ROS 2 uses, and python-canopen, which
compares them with the device too."""

import os
import subprocess
import sys

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes

from boards import WORKSPACE, Boards
from test_python_canopen import add_node, identity

SHEETS = sorted((WORKSPACE / "eds").glob("*.eds"))
NODE_ID = 5
# The images and their data sheets.
IMAGES = {"lss-slave": (), "io": ("--example", "io")}
READ_ONLY, WRITE_ONLY, ON_REQUEST, NO_DATA = 0x0601_0002, 0x0601_0001, 0x0800_0000, 0x0800_0024
OUT_OF_RANGE = 0x0609_0030, 0x0609_0031, 0x0609_0032
# The parameters of PDOs change by a procedure, and these act: an error history, signatures.
PDOS, ACTING = range(0x1400, 0x1C00), {0x1003, 0x1010, 0x1011}
# The temperature of the example is measured.
MEASURED = {(0x6401, 1)}


def run(tool, *arguments, **options):
    path = os.path.join(os.path.dirname(sys.executable), tool)
    return subprocess.run([path, *map(str, arguments)], capture_output=True, text=True, timeout=60, **options)


@pytest.fixture(params=SHEETS, ids=lambda sheet: sheet.name)
def sheet(request):
    return request.param


def test_dcfchk_has_nothing_to_say(sheet):
    checked = run("dcfchk", "-n", NODE_ID, sheet)
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")


def test_dcfgen_makes_the_configuration_of_a_network_from_it(sheet, tmp_path):
    network = tmp_path / "network.yml"
    slave = f"slave:\n  dcf: {sheet}\n  node_id: {NODE_ID}\n  heartbeat_producer: 500\n"
    network.write_text(f"master:\n  node_id: 127\n{slave}")
    made = run("dcfgen", network, cwd=tmp_path)
    assert (made.returncode, made.stderr) == (0, "")
    text = run("dcfgen", "-r", network, cwd=tmp_path)
    assert text.returncode == 0
    # A concise DCF (CiA 302-3): the number of values, then index, sub-index, size and value of each.
    assert (tmp_path / "slave.bin").read_bytes() == bytes.fromhex("01000000 1710 00 02000000 F401")


def test_python_canopen_reads_each_value(sheet):
    dictionary = canopen.import_od(str(sheet), NODE_ID)
    assert dictionary.device_information.LSS_supported
    assert dictionary[0x1014].default == 0x80 + NODE_ID
    for entry in dictionary.values():
        for value in [entry] if isinstance(entry, ODVariable) else entry.values():
            raw = getattr(value, "default_raw", None)
            if raw and value.data_type != datatypes.VISIBLE_STRING:
                assert value.default is not None, f"{value.qualname}: {raw}"
            if value.data_type in datatypes.FLOAT_TYPES:
                assert (value.min, value.max, value.default) in [(None, None, None), (None, None, 0)]


def test_the_data_sheet_of_a_new_product_is_as_good(tmp_path):
    product = tmp_path / "lamp"
    xtask = ["cargo", "run", "--quiet", "--package", "xtask", "--"]
    subprocess.run([*xtask, "new-product", "lamp", "--path", product], cwd=WORKSPACE, check=True)
    # Most of what it needs is built already.
    environment = os.environ | {"CARGO_TARGET_DIR": str(WORKSPACE / "target")}
    subprocess.run(["cargo", "eds"], cwd=product, env=environment, check=True)
    made = product / "lamp.eds"
    test_dcfchk_has_nothing_to_say(made)
    test_dcfgen_makes_the_configuration_of_a_network_from_it(made, tmp_path)
    test_python_canopen_reads_each_value(made)


def variables(node):
    """All entries but the types of a dummy."""
    for entry in node.object_dictionary.values():
        for variable in [entry] if isinstance(entry, ODVariable) else entry.values():
            if variable.index >= 0x1000:
                yield variable


def refusal(transfer, *arguments):
    """The abort code of a transfer; none if it succeeds."""
    try:
        transfer(*arguments)
    except canopen.SdoAbortedError as abort:
        return abort.code
    return None


def check(node, variable):
    """Compares an entry with the device; returns which of default and limits it has."""
    key = variable.index, variable.subindex
    name = f"{key[0]:X}h sub {key[1]}, {variable.name}"
    if variable.data_type == datatypes.DOMAIN:
        # Too long to read it here.
        node.sdo.open(*key, "rb", buffering=0)
        node.sdo.abort(ON_REQUEST)
        return False, False
    code = refusal(node.sdo.upload, *key)
    assert variable.readable == (code != WRITE_ONLY), name
    assert code in (None, NO_DATA, WRITE_ONLY), name
    value = node.sdo.upload(*key) if code is None else None
    is_number = variable.data_type in datatypes.NUMBER_TYPES
    if value is not None and is_number:
        assert 8 * len(value) == len(variable), name
    has_default = value is not None and variable.default is not None and key not in MEASURED
    if has_default:
        assert variable.decode_raw(value) == variable.default, name

    written = value or bytes(len(variable) // 8)
    if not variable.writable:
        assert refusal(node.sdo.download, *key, written) == READ_ONLY, name
        return has_default, False
    if variable.index in PDOS or variable.index in ACTING or value is None:
        return has_default, False
    assert refusal(node.sdo.download, *key, value) is None, name
    limits = [limit for limit in (variable.min, variable.max) if limit is not None]
    for limit in limits:
        assert refusal(node.sdo.download, *key, variable.encode_raw(limit)) is None, name
    if limits and is_number and len(variable) == 8:
        for beyond in {variable.min - 1, variable.max + 1} & set(range(256)):
            assert refusal(node.sdo.download, *key, bytes([beyond])) in OUT_OF_RANGE, name
    return has_default, bool(limits)


@pytest.mark.parametrize("name", IMAGES)
def test_each_entry_agrees_with_the_device_in_length_access_default_and_limits(name):
    sheet = WORKSPACE / "eds" / f"{name}.eds"
    # A board that is alone until python-canopen connects is error passive by then: its error register is 11h.
    with Boards(*IMAGES[name], "--boards", 2, "--node-id", NODE_ID) as boards, boards.connect() as network:
        node = add_node(network, NODE_ID, canopen.import_od(str(sheet), NODE_ID))
        found = [check(node, variable) for variable in variables(node)]
        print(f"{len(found)} entries; with defaults, with limits: {[sum(part) for part in zip(*found)]}")
        assert len(found) == sheet.read_text().count("\nDataType=")
        assert tuple(node.sdo[0x1018][part].raw for part in (1, 2, 3, 4)) == identity(boards)
