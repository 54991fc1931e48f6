"""The clock of the node: steady, adjusted, simulated, silent."""

from dualbrain.drivers.ros2.ros_clock import RosClock


def test_the_clock_of_the_system_jumps_only_against_the_monotonic_one():
    clock = RosClock(use_sim_time=False)
    assert clock.read(1000.0, 5.0) == ""
    assert clock.read(1000.05, 5.05) == ""
    assert clock.read(1060.05, 65.05) == ""  # the process was not scheduled for a minute
    assert "jumped by -3.00 s" in clock.read(1057.15, 65.15)
    assert clock.read(1057.25, 65.25) == ""
    assert (clock.ros, clock.elapsed) == (1057.25, 65.25)


def test_simulated_time_begins_with_the_first_message():
    clock = RosClock(use_sim_time=True)
    assert "No message on /clock" in clock.read(1000.0, 5.0)
    assert not clock.started
    assert clock.receive(20.0, 5.0) == ""
    assert clock.started
    assert clock.read(1000.1, 5.1) == ""
    assert (clock.ros, clock.elapsed) == (20.0, 20.0)


def test_simulated_time_that_goes_back_or_far_ahead_is_a_jump():
    clock = RosClock(use_sim_time=True)
    clock.receive(20.0, 5.0)
    assert clock.receive(20.0, 5.1) == ""
    assert clock.receive(20.5, 5.2) == ""
    assert "jumped by -20.50 s" in clock.receive(0.0, 5.3)
    assert "jumped by +9.00 s" in clock.receive(9.0, 5.4)


def test_a_stopped_simulation_is_reported():
    clock = RosClock(use_sim_time=True)
    clock.receive(20.0, 5.0)
    assert "/clock is silent for 1.0 s" in clock.read(1000.0, 6.0)
    clock.receive(20.1, 6.1)
    assert clock.read(1000.0, 6.2) == ""
