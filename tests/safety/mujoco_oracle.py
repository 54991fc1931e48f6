"""A MuJoCo model of a `Body`'s chain and spheres: an independent oracle of kinematics."""


def _format_numbers(values):
    return " ".join(f"{value:.12g}" for value in values)


def build_mjcf(body, obstacles=""):
    """Nested bodies frame1..n with one hinge each; links as bodies, spheres as geoms, a site at the tool."""
    opened = []
    out = ["<mujoco><compiler angle='radian'/><worldbody>", obstacles, _links(body, 0)]
    for k, joint in enumerate(body.joints, start=1):
        out.append(
            f"<body name='frame{k}' pos='{_format_numbers(joint.translation)}' quat='{_format_numbers(joint.quaternion)}'>"
        )
        out.append(f"<joint name='q{k}' axis='0 0 1'/><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>")
        out.append(_links(body, k))
        opened.append("</body>")
    return "".join([*out, *opened, "</worldbody></mujoco>"])


def _links(body, frame):
    out = []
    for link in (x for x in body.links if x.frame == frame):
        out.append(
            f"<body name='{link.name}' pos='{_format_numbers(link.translation)}' quat='{_format_numbers(link.quaternion)}'>"
        )
        balls = [s for s in body.spheres if s.link == link.name]
        for i, ball in enumerate(balls):
            out.append(
                f"<geom name='{link.name}.{i}' type='sphere' pos='{_format_numbers(ball.centre)}' size='{ball.radius:.12g}'/>"
            )
        if link.name == body.tool.link:
            out.append(
                f"<site name='tool' pos='{_format_numbers(body.tool.translation)}' quat='{_format_numbers(body.tool.quaternion)}'/>"
            )
        out.append("</body>")
    return "".join(out)


def sphere_names(body):
    """Geom names in the kernel's order of spheres."""
    return [f"{link.name}.{i}" for link in body.links for i in range(sum(s.link == link.name for s in body.spheres))]
