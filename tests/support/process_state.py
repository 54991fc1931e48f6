"""The state of a process of this machine, read from Linux."""

from pathlib import Path


def process_state(pid: int) -> str:
    """Its letter in Linux (R, S, T ...), "" if it has ended, also if its parent has not collected it yet (Z, X)."""
    try:
        letter = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:  # the process can end between the opening and the reading
        return ""
    return "" if letter in "ZX" else letter
