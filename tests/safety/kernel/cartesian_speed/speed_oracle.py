"""An independent oracle of Cartesian speeds: float64 kinematics from the robot model, and finite differences."""

import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix


class SpeedOracle:
    """Positions and velocities of all sphere centres, of held spheres and of the tool; nothing is from the kernel."""

    def __init__(self, robot_model, held=()):
        """`held` are centres (k, 3) in the tool frame."""
        self.model = robot_model
        links = {link.name: link for link in robot_model.links}
        self.local_points = []
        for link in robot_model.links:
            turn, shift = quaternion_to_matrix(link.quaternion), np.array(link.translation)
            for sphere in robot_model.spheres:
                if sphere.link == link.name:
                    centre, slide = shift + turn @ np.array(sphere.centre), turn @ np.array(link.slide)
                    self.local_points.append((link.frame, centre, slide))
        tool, link = robot_model.tool, links[robot_model.tool.link]
        turn = quaternion_to_matrix(link.quaternion)
        origin = np.array(link.translation) + turn @ np.array(tool.translation)
        axes = turn @ quaternion_to_matrix(tool.quaternion)
        for centre in held:
            self.local_points.append((link.frame, origin + axes @ np.asarray(centre, float), np.zeros(3)))
        self.local_points.append((link.frame, origin, np.zeros(3)))

    def frames(self, q):
        """Rotation and origin of every frame; frame 0 is the base."""
        found = [(np.eye(3), np.zeros(3))]
        for joint, angle in zip(self.model.joints, q, strict=True):
            turn, origin = found[-1]
            origin = origin + turn @ np.array(joint.translation)
            turn = turn @ quaternion_to_matrix(joint.quaternion)
            if joint.kind == "prismatic":
                found.append((turn, origin + angle * turn[:, 2]))
                continue
            c, s = np.cos(angle), np.sin(angle)
            found.append((turn @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), origin))
        return found

    def points(self, q, opening=0.0):
        """Positions (k, 3) of all points; the tool is the last one."""
        frames = self.frames(q)
        return np.array([frames[f][1] + frames[f][0] @ (p + opening * slide) for f, p, slide in self.local_points])

    def jacobian(self, q, opening=0.0):
        """Jacobian (k, 3, n) of all points by central differences, exact to about 1e-9 m/rad."""
        step, columns = 1e-5, []
        for k in range(len(q)):
            e = np.eye(len(q))[k] * step
            columns.append((self.points(q + e, opening) - self.points(q - e, opening)) / (2.0 * step))
        return np.stack(columns, axis=-1)

    def speeds(self, q, u, opening=0.0):
        """Speeds (k,) [m/s] of all points at the control u."""
        step = 1e-5
        moved = self.points(q + step * u, opening) - self.points(q - step * u, opening)
        return np.linalg.norm(moved, axis=1) / (2.0 * step)
