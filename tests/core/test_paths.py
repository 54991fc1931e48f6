"""The data folder by the environment."""

from pathlib import Path

import pytest

from dualbrain.core.paths import default_home


@pytest.mark.parametrize(
    ("environ", "expected"),
    [
        ({"DUALBRAIN_HOME": "/a", "XDG_DATA_HOME": "/b", "HOME": "/c"}, "/a"),
        ({"XDG_DATA_HOME": "/b", "HOME": "/c"}, "/b/dualbrain"),
        ({"XDG_DATA_HOME": "relative", "HOME": "/c"}, "/c/.local/share/dualbrain"),
        ({"XDG_DATA_HOME": "", "HOME": "/c"}, "/c/.local/share/dualbrain"),
        ({}, str(Path.home() / ".local/share/dualbrain")),
    ],
)
def test_a_relative_folder_of_the_xdg_specification_has_no_effect(environ, expected):
    assert default_home(environ) == Path(expected)
