"""Reads what `lss apply` writes with programs of others, and gives `lss apply` what they write."""

import canopen

from boards import WORKSPACE, Boards
from test_data_sheets import run

PRODUCT = "00000000:4C535334:00010000"
# Of 5, in the order of the table: some kinds of values, in different notations.
VALUES = """
"Filter constant of the temperature" = 4
"Calibration of the temperature.Gain" = 1.25
"2101:2" = -5
"2101:3" = "Ada Lovelace"
"1014" = "$NODEID+0x90"
"1A00:0" = 1
"1A00:1" = "0x64010110"
"""


def test_dcfs_of_lss_are_those_of_other_programs(tmp_path):
    table = tmp_path / "network.toml"
    with Boards("--example", "io", "--boards", 2) as boards:
        addresses = [f"{PRODUCT}:{number:08X}" for number in boards.serial_numbers]
        sheet = WORKSPACE / "eds" / "io.eds"
        table.write_text(
            f'[[node]]\nid = 5\nname = "pump"\naddress = "{addresses[0]}"\neds = "{sheet}"\n[node.values]\n{VALUES}\n'
            f'[[node]]\nid = 6\naddress = "{addresses[1]}"\neds = "{sheet}"\n'
        )
        assert boards.lss("apply", table, "--write-dcf", tmp_path)[0] == 0
        for node_id in (5, 6):
            checked = run("dcfchk", "-n", node_id, tmp_path / f"node_{node_id}.dcf")
            assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")

        dictionary = canopen.import_od(str(tmp_path / "node_5.dcf"))
        assert (dictionary.node_id, dictionary.bitrate) == (5, 125_000)
        assert dictionary[0x2100].value == 4
        assert dictionary[0x2101][1].value_raw == "0x3FA00000"
        assert dictionary[0x2101][2].value == -5
        assert dictionary[0x2101][3].value == "Ada Lovelace"
        assert dictionary[0x1014].value == 0x95
        with boards.connect() as network:
            node = network.add_node(5, dictionary)
            compared = 0
            for entry in dictionary.values():
                for variable in [entry] if isinstance(entry, canopen.objectdictionary.ODVariable) else entry.values():
                    if getattr(variable, "value", None) is not None:
                        value = node.sdo.upload(variable.index, variable.subindex)
                        assert variable.decode_raw(value) == variable.value, variable.qualname
                        compared += 1
            assert compared > 50

        # The file of one board brings it back, and is the same after a way through python-canopen.
        node_5 = tmp_path / "node_5.dcf"
        assert boards.lss("apply", node_5)[0] == 0
        exported = tmp_path / "exported.dcf"
        canopen.export_od(dictionary, str(exported))
        code, printed = boards.lss("apply", exported, "--plan")
        assert code == 0
        assert f"node 5  {addresses[0]}  no change" in printed
