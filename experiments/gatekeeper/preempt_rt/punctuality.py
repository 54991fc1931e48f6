"""Result of one run of the program, as it prints it."""

from __future__ import annotations

import msgspec

from dualbrain.errors import ConfigurationError

LINE_START = '{"kernel":'
SHOWN_CHARACTERS = 1000
"""Length of the end of the console that an error shows."""


class Punctuality(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Punctuality of one run; times in µs.

    - `kernel`: release. `realtime`: /sys/kernel/realtime is 1, so that it is a PREEMPT_RT kernel.
    - `policy` and `priority` of the control thread, as the kernel reports them; `memory_locked`.
    - `busy` processes beside it.
    - `periods` = `ticks` + `missed`, the periods without a tick; `late` ticks began more than 0.2 ms after their time.
    - `delay_...`: of the begin of a tick after its time. `work_max_us`: longest tick.
    - `moving`: ticks with a control other than zero, `modified`: ticks in which the filter changed the nominal control,
      `dropped`: lost records of the log.
    """

    kernel: str
    realtime: bool
    policy: str
    priority: int
    memory_locked: bool
    busy: int
    periods: int
    ticks: int
    missed: int
    late: int
    delay_median_us: int
    delay_p999_us: int
    delay_max_us: int
    work_max_us: int
    moving: int
    modified: int
    dropped: int


def parse_console(text: str) -> Punctuality:
    """The result in the output `text` of a machine or of the program, among other lines.

    Raises:
        ConfigurationError: there is not exactly one result, or it is damaged.
    """
    found = [line for line in text.splitlines() if line.startswith(LINE_START)]
    end = f"The output ends with:\n{text[-SHOWN_CHARACTERS:]}"
    if len(found) != 1:
        raise ConfigurationError.stating(f"The output has {len(found)} results instead of one.", fix=end)
    try:
        return msgspec.json.decode(found[0], type=Punctuality)
    except msgspec.DecodeError as error:
        raise ConfigurationError.stating(f"The result is damaged: {error}.", fix=end) from error
