"""At a site a robot has its own vocabulary, narrowed; an adapter that was taught the robot's own fits there, too."""

import pytest

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.compatibility import require_fit
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.contracts.registry import narrows
from dualbrain.errors import InvalidSetup
from dualbrain.grounding.vocabulary import vocabulary, vocabulary_at
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime import session
from dualbrain.runtime.session import Session
from tests.stories.story_session import settings, times

CAPS = "[robot]\ntool_speed = 0.25\n[limits]\nvelocity = 0.5\n"


@pytest.fixture
def site(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(CAPS)
    return path


@pytest.mark.parametrize("robot", ["panda", "ur5e", "base", "mobile_panda"])
def test_whatever_a_site_caps_its_vocabulary_only_narrows_the_robots_own(site, robot):
    own, there = vocabulary(robot), vocabulary_at(robot, site)
    assert there.hash != own.hash
    assert narrows(there, own)
    assert not narrows(own, there)


def test_an_adapter_fits_a_site_that_narrows_and_nothing_else(site):
    own, there = vocabulary("panda").hash, vocabulary_at("panda", site).hash
    card = read_adapter_card(packaged_folder("base-135m"))
    require_fit(card, "panda", there, {there: own})
    for wrong in ({}, {own: there}, {"00000000": own}, {there: "00000000"}):
        with pytest.raises(InvalidSetup, match="vocabulary of adapter"):
            require_fit(card, "panda", there, wrong)


@pytest.mark.parametrize("caps", [CAPS, ""])
def test_a_session_says_which_vocabulary_its_site_narrows(site, tmp_path, monkeypatch, caps):
    opened = {}

    def open_planner(name, cache, **told):
        opened.update(told)
        return ScriptedPlanner([])

    site.write_text(caps)
    monkeypatch.setattr(session, "open_planner", open_planner)
    with Session(settings(tmp_path, site=site), times(), {}):
        pass
    here = vocabulary_at("panda", site).hash
    assert opened["registry"] == here
    assert opened["narrowed"] == {here: vocabulary("panda").hash}
