"""Makes the changes of one step of docs/product.md in a product: apply_tutorial.py STEP FOLDER."""

import pathlib
import re
import sys

step, folder = sys.argv[1], pathlib.Path(sys.argv[2])
tutorial = pathlib.Path(__file__).parent.with_name("docs") / "product.md"
sections = re.split(r"^## (\d)\. ", tutorial.read_text(), flags=re.M)
text = sections[sections.index(step) + 1]


def place(lines, wanted, start):
    """The line at which these begin, however deep they are indented."""
    wanted = [line.strip() for line in wanted]
    for at in range(start, len(lines)):
        if [line.strip() for line in lines[at : at + len(wanted)]] == wanted:
            return at
    sys.exit(f"docs/product.md, step {step}: these lines are not in {path}:\n" + "\n".join(wanted))


for listing in re.finditer(r"```diff\n(.*?)```", text, flags=re.S):
    # A listing belongs to the file that was named last.
    path = folder / re.findall(r"`((?:src|tests)/\w+\.rs)`", text[: listing.start()])[-1]
    lines, at = path.read_text().splitlines(), 0
    for hunk in listing[1].split("@@\n"):
        old = [line[1:] for line in hunk.splitlines() if line[0] != "+"]
        new = [line[1:] for line in hunk.splitlines() if line[0] != "-"]
        at = place(lines, old, at) if old else len(lines)
        lines[at : at + len(old)] = new
        at += len(new)
    path.write_text("\n".join(lines) + "\n")
