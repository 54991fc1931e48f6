"""The first signal asks, the second leaves, and afterwards everything is as it was."""

import signal

import pytest

from dualbrain.cli.common.signals import SIGNALS, ctrl_c


@pytest.mark.parametrize("second", SIGNALS)
@pytest.mark.parametrize("first", SIGNALS)
def test_the_first_signal_asks_and_the_second_leaves(first, second):
    before, asked = [signal.getsignal(each) for each in SIGNALS], []
    with ctrl_c(lambda: asked.append(first)):
        signal.raise_signal(first)
        assert asked == [first]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(second)
    assert asked == [first]
    assert [signal.getsignal(each) for each in SIGNALS] == before
