"""What an engine that broke leaves behind is no answer of a model's."""

from types import SimpleNamespace

import pytest
from proofs import language

from dualbrain.planner.chat import Answer
from dualbrain.planner.protocol import CRASHED, TIMEOUT


@pytest.mark.parametrize("fault", [TIMEOUT, CRASHED])
def test_an_accident_ends_the_unit(fault):
    broken = SimpleNamespace(tell=lambda path, body: Answer("", fault, "gone"))
    with pytest.raises(language.NoAnswer, match=fault):
        language.free(broken, SimpleNamespace(prompt=[]))
    with pytest.raises(language.NoAnswer, match=fault):
        language.by_chance(broken, [], 1.0, 0)
