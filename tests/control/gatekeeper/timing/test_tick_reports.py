"""Tick reports: an observer of a gatekeeper gets them at the rate that people can use."""

from concurrent.futures import ThreadPoolExecutor

from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import TickReport
from tests.control.gatekeeper.lockstep_cell import make_cell

SECONDS = 2.0


def test_tick_reports_arrive_about_fifteen_times_per_second_of_the_robots_time(tmp_path):
    reports, connected_at = [], []
    with ThreadPoolExecutor() as background:

        def on_period(now):
            if observer.done():
                connected_at.append(now)
            if connected_at and now > connected_at[0] + SECONDS:
                cell.gatekeeper.shut_down()

        cell = make_cell(tmp_path, on_period=on_period)
        observer = background.submit(GatekeeperClient, cell.socket, on_report=reports.append)
        cell.gatekeeper.run()
        cell.server.close()
        assert observer.result().disconnected.wait(20.0)
        observer.result().close()
    stamps = [report.t for report in reports if isinstance(report, TickReport)]
    assert 10.0 * SECONDS < len(stamps) < 20.0 * SECONDS
    assert stamps == sorted(set(stamps))
