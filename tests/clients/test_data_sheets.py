"""Reads the data sheets with programs of others: Lely's dcfchk and dcfgen, which ROS 2 uses, and python-canopen."""

import os
import subprocess
import sys

import canopen
import pytest
from canopen.objectdictionary import datatypes

from boards import WORKSPACE

SHEETS = sorted((WORKSPACE / "eds").glob("*.eds"))
NODE_ID = 5


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
        for value in [entry] if isinstance(entry, canopen.objectdictionary.ODVariable) else entry.values():
            raw = getattr(value, "default_raw", None)
            if raw and value.data_type != datatypes.VISIBLE_STRING:
                assert value.default is not None, f"{value.qualname}: {raw}"
            if value.data_type in datatypes.FLOAT_TYPES:
                assert (value.min, value.max, value.default) in [(None, None, None), (None, None, 0)]
