"""The commands of the page about microcontrollers bring the safety layer from a URDF to an emulated board."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "docs/how-to/guard/microcontroller.md"
LINK = """<link name="{name}"><collision><origin xyz="0 0 {z}"/><geometry>{shape}</geometry></collision></link>"""
JOINT = """<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 {z}"/>
<axis xyz="{axis}"/><limit lower="-2" upper="2" velocity="1.5" effort="50"/></joint>"""
URDF = f"""<robot name="my_arm">
{LINK.format(name="base", z=0.05, shape='<cylinder radius="0.06" length="0.1"/>')}
{LINK.format(name="arm", z=0.2, shape='<cylinder radius="0.05" length="0.3"/>')}
{LINK.format(name="hand", z=0.05, shape='<sphere radius="0.04"/>')}
{JOINT.format(name="turn", parent="base", child="arm", z=0.12, axis="0 0 1")}
{JOINT.format(name="bend", parent="arm", child="hand", z=0.4, axis="0 1 0")}
</robot>"""


def test_the_commands_of_the_page_run_in_their_order(tmp_path):
    (block,) = re.findall(r"## From your robot to a board\n\n```bash\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    commands = [shlex.split(line, comments=True) for line in block.splitlines()]
    commands = [words[1:] for words in commands if words[0] == "dualbrain"]  # packages come with the set-up
    assert [words[:2] for words in commands][-1] == ["doctor", "--robot"]
    (tmp_path / "my_arm.urdf").write_text(URDF)
    environment = {**os.environ, "DUALBRAIN_HOME": str(tmp_path / "home"), "COLUMNS": "200"}
    text = ""
    for words in commands:
        more = ["--quick"] if words[:2] == ["robot", "init"] else []  # fewer samples of the links
        command = [sys.executable, "-m", "dualbrain", *words, *more]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=300
        )
        assert done.returncode == 0, (words, done.stderr)
        text += done.stdout + done.stderr
    (tables,) = set(re.findall(r"hash (\w{16})$|robot tables (\w{16})", text, re.MULTILINE)[0]) - {""}
    assert text.count(tables) == 3  # the file, the board after the build, and the board as seen by doctor
    assert "as on this computer" in text
    assert (tmp_path / "firmware/firmware.elf").stat().st_mode & 0o077 == 0
