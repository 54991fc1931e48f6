"""Nested frames of the links: they show the poses of the links, and send only what changed visibly."""

from collections import Counter

import numpy as np
import pytest

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Pose
from dualbrain.robots.loader import load_robot
from dualbrain.visualization.live.motion.frame_pose import FramePose
from dualbrain.visualization.live.motion.link_frames import LinkFrames, links_before, relative_pose
from dualbrain.visualization.live.motion.motion_geometry import link_poses
from dualbrain.visualization.live.view import find_free_port, start_server

PANDA = load_robot("panda")
HOME = np.array(PANDA.home)
PIXEL_M = 0.002


class Frame:
    """A frame of a page, which counts the values that it receives."""

    def __init__(self, sent: Counter) -> None:
        self.__dict__.update(sent=sent, position=(0.0, 0.0, 0.0), wxyz=(1.0, 0.0, 0.0, 0.0))

    def __setattr__(self, name: str, value: tuple[float, ...]) -> None:
        self.sent[name] += 1
        self.__dict__[name] = value


class Page:
    """A scene that keeps the frames by their path."""

    def __init__(self) -> None:
        self.frames, self.sent = {}, Counter()

    def add_frame(self, path: str, **_options) -> Frame:
        return self.frames.setdefault(path, Frame(self.sent))

    def shown(self, path: str) -> np.ndarray:
        """T_world_frame (4, 4) of the frame at `path`, as a browser computes it from all frames above."""
        T = np.eye(4)
        ends = [k for k, letter in enumerate(path) if letter == "/"][1:]
        for k in (*ends, len(path)):
            if (frame := self.frames.get(path[:k])) is not None:
                local = np.eye(4)
                local[:3, :3], local[:3, 3] = quaternion_to_matrix(frame.wxyz), frame.position
                T = T @ local
        return T


@pytest.mark.parametrize("robot", ["panda", "ur5e", "mobile_panda"])
def test_every_link_follows_the_first_link_of_its_own_or_an_earlier_frame(robot):
    links = {link.name: link for link in load_robot(robot).links}
    parents, placed = links_before(tuple(links.values())), {""}
    assert parents.keys() == links.keys()
    for name, parent in parents.items():
        assert parent in placed
        assert parent == "" or links[parent].frame <= links[name].frame
        placed.add(name)
    assert [name for name, parent in parents.items() if not parent] == [min(parents, key=lambda one: links[one].frame)]


def test_a_page_shows_each_link_where_it_is_within_a_pixel():
    page = Page()
    frames, rng = LinkFrames(page, "/robot", PANDA), np.random.default_rng(1)
    q = HOME.copy()
    for _ in range(200):
        q += rng.normal(0.0, 2e-4, 7)
        poses = link_poses(PANDA, q, 0.02)
        frames.update(poses)
        for name, pose in poses.items():
            assert page.shown(frames.paths[name])[:3, 3] == pytest.approx(pose.position, abs=PIXEL_M)


def test_a_turning_joint_sends_one_value_and_a_robot_at_rest_none():
    page = Page()
    frames = LinkFrames(page, "/robot", PANDA)
    frames.update(link_poses(PANDA, HOME, 0.02))
    page.sent.clear()
    frames.update(link_poses(PANDA, HOME, 0.02))
    assert not page.sent
    frames.update(link_poses(PANDA, HOME + 0.1 * np.eye(7)[1], 0.02))
    assert page.sent == {"wxyz": 1}
    frames.update(link_poses(PANDA, HOME + 0.1 * np.eye(7)[1], 0.03))
    assert page.sent == {"wxyz": 1, "position": 2}, "the two fingers"


def test_a_relative_pose_and_its_reference_are_the_pose():
    rng = np.random.default_rng(2)
    for _ in range(20):
        reference, pose = (
            Pose(tuple(rng.normal(size=3)), tuple(q / np.linalg.norm(q))) for q in rng.normal(size=(2, 4))
        )
        relative = relative_pose(reference, pose)
        turn = quaternion_to_matrix(reference.quaternion)
        assert turn @ relative.position + reference.position == pytest.approx(pose.position)
        assert turn @ quaternion_to_matrix(relative.quaternion) == pytest.approx(quaternion_to_matrix(pose.quaternion))


def test_a_pose_sends_the_messages_of_the_setters_of_viser():
    server = start_server(find_free_port(18420, 20))
    sent: list[str] = []
    try:
        fast, plain = (server.scene.add_frame(name) for name in ("/fast", "/plain"))
        server.scene._websock_interface.queue_message = lambda message: sent.append(repr(message))
        pose = Pose((0.1, 0.2, 0.3), (0.6, 0.0, 0.8, 0.0))
        FramePose(fast).show(pose)
        plain.position, plain.wxyz = pose.position, pose.quaternion
    finally:
        server.stop()
    assert len(sent) == 4
    assert [one.replace("/fast", "/plain") for one in sent[:2]] == sent[2:]
