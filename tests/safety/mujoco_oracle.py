"""MuJoCo model of a robot model's chain and spheres: an independent oracle of kinematics."""


def _format_numbers(values):
    return " ".join(f"{value:.12g}" for value in values)


def _placed(tag, name, position, quaternion):
    """An opening tag with name, position and quaternion."""
    return f"<{tag} name='{name}' pos='{_format_numbers(position)}' quat='{_format_numbers(quaternion)}'>"


def build_mjcf(robot_model, obstacles=""):
    """Nested bodies frame1..n with one hinge each; links as bodies, spheres as geoms, a site at the tool."""
    closing = []
    out = ["<mujoco><compiler angle='radian'/><worldbody>", obstacles, _links(robot_model, 0)]
    for k, joint in enumerate(robot_model.joints, start=1):
        out.append(_placed("body", f"frame{k}", joint.translation, joint.quaternion))
        out.append(f"<joint name='q{k}' axis='0 0 1'/><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>")
        out.append(_links(robot_model, k))
        closing.append("</body>")
    return "".join([*out, *closing, "</worldbody></mujoco>"])


def _links(robot_model, frame):
    out = []
    for link in (x for x in robot_model.links if x.frame == frame):
        out.append(_placed("body", link.name, link.translation, link.quaternion))
        for i, sphere in enumerate(s for s in robot_model.spheres if s.link == link.name):
            position = _format_numbers(sphere.centre)
            out.append(f"<geom name='{link.name}.{i}' type='sphere' pos='{position}' size='{sphere.radius:.12g}'/>")
        if link.name == robot_model.tool.link:
            out.append(_placed("site", "tool", robot_model.tool.translation, robot_model.tool.quaternion) + "</site>")
        out.append("</body>")
    return "".join(out)


def sphere_names(robot_model):
    """Geom names in the kernel's order of spheres."""
    return [
        f"{link.name}.{i}"
        for link in robot_model.links
        for i in range(sum(s.link == link.name for s in robot_model.spheres))
    ]
