"""The GL library is chosen before MuJoCo is imported, and a missing one is a sentence."""

import pytest

from dualbrain.cli.common import graphics
from dualbrain.cli.common.graphics import DISABLED_VALUES, GL_LIBRARIES, choose_graphics


@pytest.fixture
def installed(monkeypatch):
    """Pretend that exactly the given libraries are installed."""

    def only(*names):
        monkeypatch.setattr(graphics, "find_library", lambda name: f"lib{name}.so" if name in names else None)

    return only


def test_egl_where_nothing_is_asked_for(installed):
    installed("EGL", "GL")
    environ = {}
    assert choose_graphics(environ) == ""
    assert environ == {"MUJOCO_GL": "egl"}


@pytest.mark.parametrize("wanted", GL_LIBRARIES)
def test_what_is_asked_for_and_installed_is_used(installed, wanted):
    installed(*GL_LIBRARIES[wanted])
    environ = {"MUJOCO_GL": wanted.upper()}
    assert choose_graphics(environ) == ""
    assert environ == {"MUJOCO_GL": wanted}


@pytest.mark.parametrize("wanted", ["", *GL_LIBRARIES, "bogus", *DISABLED_VALUES])
def test_without_libraries_rendering_is_off_and_the_reason_is_reported(installed, wanted):
    installed()
    environ = {"MUJOCO_GL": wanted}
    why = choose_graphics(environ)
    assert (wanted or "egl") in why
    assert environ["MUJOCO_GL"] in DISABLED_VALUES
    assert all(f"lib{name}" in why for name in GL_LIBRARIES.get(wanted, ()))
