"""Numbers of a kernel step against numpy by definition, for random robot models and cases.

Bounds hold and are not looser than stated, lists contain exactly the required entries, and rows are the defined rows.
A wrong factor, index or sign fails here, also if it would only cost time.
"""

import numpy as np
import pytest

from tests.safety.kernel_step import random_cases
from tests.safety.kernel_step.reference_obstacles import MAX_DISTANCE
from tests.safety.kernel_step.reference_rows import LOWER, OBSTACLE, SELF, UPPER, ReferenceRows

KINDS = {
    "still": {"moving": False, "with_separation": False, "permits": False, "n_held": 0, "n_rows": 0},
    "everything": {},
    "mobile": {"mobile": True},
    "alone": {"n_obstacles": 0, "permits": False},
    "crowd": {"n_obstacles": 21, "with_separation": False},
    "balls at rest": {"n_obstacles": 21, "with_separation": False, "moving": False, "spheres_only": True},
    "balls": {"n_obstacles": 21, "with_separation": False, "spheres_only": True},
    "one of each": {"n_obstacles": 1, "n_held": 1, "n_rows": 1, "permits": False},
}
STOPPING = 1 | 2 | 4 | 8 | 16 | 32 | 64 | 256
"""Reasons for which the step computes nothing."""
SIZES = [(7, 6), (8, 19), (2, 3), (5, 8)]


def close(got, expected, what, tolerance=1e-9):
    np.testing.assert_allclose(got, expected, atol=tolerance, rtol=1e-9, err_msg=what)


def run_both(rng, n, links, kind, oracle=ReferenceRows, *, crowded=False):
    """A kernel after one step and the numpy reference of the same case; None if the kernel rejected the input."""
    model = random_cases.random_model(rng, n, links)
    made = random_cases.make_kernel(model)
    rest = random_cases.StepCase(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.empty((0, 29)))
    box = np.array([-model["v_max"], model["v_max"]])
    points = ReferenceRows(model, rest, box, box).centre
    m = random_cases.random_case(rng, model, points, **KINDS[kind])
    if crowded:  # fast toward close obstacles, with contradicting user rows
        m.u_nom = m.u_prev = model["v_max"] * rng.uniform(-0.5, 0.5, n)
        m.rows = np.concatenate([m.rows, -m.rows * np.array([*[1.0] * n, -0.01, 1.0, -1.0])]).reshape(-1, n + 3)
    random_cases.upload_case(made, model, m)
    answer = random_cases.run_step(made, m)
    if answer.status == 3 or answer.flags & STOPPING:
        return None
    got = random_cases.step_internals(made, n, links)
    at = got["step"]
    box, trust = ((at[low][:n], at[high][:n]) for low, high in (("lower", "upper"), ("trust_lower", "trust_upper")))
    return made, model, m, answer, got, oracle(model, m, box, trust)


def body_and_scene(got, w):
    n, held = w.n, len(w.model["spheres"]) + 8
    close(got["model"]["reach"][:n, :held], w.reach, "longest lever arms")
    close(got["model"]["link_reach"][:n, : w.links + 1], w.link_reach, "longest lever arms of links")
    close(got["model"]["bounding_sphere"][: w.links], w.local_bounding_spheres[:-1], "bounding spheres of links")
    close(got["scene"]["held_bounding_sphere"], w.local_bounding_spheres[-1], "bounding sphere of the held object")
    frames = [*np.repeat(w.link_frame[:-1], np.diff(w.first[:-1])), *[n] * 8]
    close(got["model"]["sphere_frame"][:held], frames, "frames of spheres")
    scene = got["scene"]
    for j, t in enumerate(w.obstacles):
        expected = {
            "x": t.start_position[0],
            "y": t.start_position[1],
            "z": t.start_position[2],
            "vx": t.velocity[0],
            "vy": t.velocity[1],
            "vz": t.velocity[2],
            "ax": t.rotation[0, t.axis],
            "ay": t.rotation[1, t.axis],
            "az": t.rotation[2, t.axis],
            "half": t.length,
            "radius": t.capsule_radius,
            "margin": t.margin,
            "alpha": t.alpha,
            "velocity_error": t.velocity_error,
            "max_speed": t.speed,
            "link_mask": t.mask,
            "known": t.flags & 1,
            "moving": not t.flags & 2,
            "rank": t.rank,
            "plain": t.is_plain_capsule,
        }
        for name, value in expected.items():
            assert scene[name][j] == pytest.approx(float(value), abs=1e-12), name
    assert scene["any_half_space"][0] == any(t.shape == 2 for t in w.obstacles)
    assert scene["any_separation"][0] == any(t.brake > 0 for t in w.obstacles)
    assert scene["any_moving"][0] == any(not t.flags & 2 for t in w.obstacles)


def bounds(w):
    """The box: velocity limit, acceleration around the last control, and braking before a joint limit."""
    m, y = w.model, w.y
    step = m["a_max"] * m["period"]
    low, high = np.maximum(-m["v_max"], w.case.u_prev - step), np.minimum(m["v_max"], w.case.u_prev + step)

    def toward(d):
        linear, half = m["alpha_joint"] * d, 0.5 * step
        braking = np.sqrt(half**2 + 2.0 * m["a_max"] * np.maximum(d, 0.0)) - half
        return np.where(d > 0.0, np.minimum(linear, braking), np.maximum(linear, -4.0 * m["recovery"])) - m["tracking"]

    lower = np.clip(-toward(y - m["q_lower"] - m["rounding"]), low, high)
    close(w.low, lower, "lower bounds")
    close(w.high, np.clip(toward(m["q_upper"] - m["rounding"] - y), lower, high), "upper bounds")


def motion(got, w):
    n, count = w.n, len(w.centre)
    assert got["step"]["n_spheres"][0] == count
    close(np.stack([got["step"][e][:count] for e in "xyz"], axis=1), w.centre, "centres")
    close(got["step"]["r"][:count], w.radius, "radii")
    for f, (R, p) in enumerate(w.frames):
        close(got["step"]["rotation"][f].reshape(3, 3), R, "frames")
        close(got["step"]["origin"][f], p, "frames")
    values = got["motion"]
    close(np.stack([values[f"v{e}"][:count] for e in "xyz"], axis=1), w.velocity, "velocities")
    close(np.stack([values[f"a{e}"][:count] for e in "xyz"], axis=1), w.acceleration, "accelerations")
    close(values["spread"][:count], w.spread, "spread")
    close(values["chain"][: n + 1, 12:], w.twist, "twists")
    u, frames = 0.5 * (w.low + w.high), range(n + 1)
    close(values["chain"][: n + 1, :3], np.array([w.turn_rate(u, f) for f in frames]), "angular velocities")
    close(values["chain"][: n + 1, 6:9], np.array([w.turn_acceleration(u, f) for f in frames]), "and their rates")
    close(values["joint_max_speed"][:n], w.max_joint_speed, "maximum joint speeds")
    close(values["joint_half_width"][:n], w.half_width, "half widths of the trust region")
    close(values["joint_excess"][:n], w.box_excess, "excess of the control bounds")
    close(values["trust_speed"][: w.links + 1], w.trust_region_speed, "maximum speeds in the trust region")
    close(values["max_speed"][: w.links + 1], w.max_speed, "maximum speeds")
    close(values["sampling_term"][: w.links + 1], w.max_acceleration_term, "sampling terms")
    parts = ("bound_x", "bound_y", "bound_z", "bound_r", "inner_distance", "centres_radius")
    bound = np.stack([values[name][: w.links + 1] for name in parts], 1)
    close(bound, w.bounding_spheres, "bounding spheres at the posture")


def lists(got, w):
    if "broadphase" not in got:
        return
    around, count = got["broadphase"], len(w.obstacles)
    places = np.stack([around[e][:count] for e in "xyz"], axis=1)
    close(places, np.array([t.position for t in w.obstacles]), "extrapolated obstacles")
    close(around["margin"][:count], [w.margin(t) for t in w.obstacles], "margins")
    close(around["alpha"][:count], [w.alpha(t) for t in w.obstacles], "gains")
    assert [list(near) for near in around["near"]] == w.nearby_obstacles


def projected(made, w):
    """The lists of a projection: with more clearance, and only for known obstacles."""
    more = ReferenceRows(w.model, w.case, (w.low, w.high), (w.trust_low, w.trust_high))
    more.extra, more.known_only = 0.013, True
    lists(random_cases.step_internals(made, w.n, w.links, more.extra, known_only=True), more)


def spans(values, w, names):
    """Runs of adjacent rows that the same joints move: maximal, and built for one sphere or for several."""
    expected = []
    for kind, i, j in names:
        if kind == OBSTACLE:
            link = next(link for link in range(w.links + 1) if i in w.sphere_indices(link))
            social = [
                k
                for k in w.nearby_obstacles[link]
                if w.obstacles[k].is_plain_capsule and (link, k) not in w.case.permits
            ]
            expected.append(
                (0, w.link_frame[link], float(not (j in social and len(social) > len(w.sphere_indices(link)))))
            )
        elif kind == SELF:
            expected.append((w.frame[j], w.frame[i], 1.0))
    begins = [r for r, span in enumerate(expected) if r == 0 or span != expected[r - 1]]
    count = int(values["n_spans"][0])
    assert values["span_first"][:count].tolist() == begins
    got = np.stack(
        [values[name][:count] for name in ("span_first_joint", "span_end_joint", "span_many_spheres")], axis=1
    )
    close(got, np.array([expected[r] for r in begins]).reshape(-1, 3), "spans")


def rows(got, w):
    values = got["rows"]
    count = int(values["count"][0])
    names = [tuple(int(values[e][r]) for e in ("kind", "i", "j")) for r in range(count)]
    assert len(set(names)) == count
    assert set(names) == set(w.rows)
    if not w.zero_gradient_rows:
        spans(values, w, names)
    padded = -(-count // 8) * 8
    assert np.all(values["a"][: w.n, count:padded] == 0.0), "padding rows have no coefficients"
    assert np.all(values["b"][count:padded] == -1e9)
    for r, name in enumerate(names):
        a, b, h, norm, yields, moves, rank = w.rows[name]
        close(values["a"][: w.n, r], a, f"normal of {name}")
        close(values["h"][r], h, f"h of {name}")
        close(values["norm"][r], norm, f"norm of {name}")
        close(values["b"][r], b, f"right side of {name}")
        assert (values["clip"][r], values["moving"][r], values["rank"][r]) == (yields, moves, rank), name


def optimal(answer, got, w):
    """Binding rows explain the change of the control: R (u - u_nom) is the sum of multiplier times normal."""
    assert (answer.n_rows, answer.relaxed_mask) == (got["rows"]["count"][0], 0)
    S = w.model["scale"]
    pull = np.linalg.solve(S @ S.T, np.array(answer.u) - w.case.u_nom)
    for kind, i, j, h, weight in answer.binding_rows:
        if kind in (LOWER, UPPER):
            side = np.eye(w.n)[i] * (1.0 if kind == LOWER else -1.0)
            bound = (w.low if kind == LOWER else -w.high)[i]
            assert h == 0.0
        else:
            side, bound, gap, *_ = w.rows[kind, i, j]
            assert h == pytest.approx(gap, abs=1e-9)
        assert weight > 0.0
        assert side @ answer.u == pytest.approx(bound, abs=1e-9), "the row binds"
        pull = pull - weight * side
    close(pull, 0.0, "stationarity", 1e-6)
    warm = got["step"]["warm"][: int(got["step"]["n_warm"][0]), :3]
    assert [tuple(row) for row in warm] == [row[:3] for row in answer.binding_rows]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_every_number_of_a_step_is_what_it_is_defined_as(kind, size):
    rng = np.random.default_rng(len(kind) + 100 * size[0])
    seen = 0
    for _ in range(40):
        found = run_both(rng, *size, kind)
        if found is None:
            continue
        made, _, _, answer, got, w = found
        body_and_scene(got, w)
        bounds(w)
        motion(got, w)
        lists(got, w)
        assert answer.h_min == pytest.approx(w.h_min, abs=1e-9)
        projected(made, w)
        if answer.status < 2:  # otherwise the right-hand sides are those of the relaxation
            rows(got, w)
            optimal(answer, got, w)
        visits = {
            tuple(int(got["step"][e][r]) for e in ("revisit_first", "revisit_spheres", "revisit_other"))
            for r in range(int(got["step"]["revisits"][0]))
        }
        assert visits == w.revisit_pairs
        # the first rows of a step start without a nearest pair, later ones with the nearest pair of the first ones
        assert got["step"]["narrow_phase_count"][0] in (w.n_pair_checks(MAX_DISTANCE), w.n_pair_checks(w.h_min))
        seen += 1
        if seen == 3:
            return
    raise AssertionError("too few random cases have a result")


def around(w, expected):
    """The trust region around a control: 2 % of v_max to either side, or the whole box of a joint if it is narrow."""
    reach = 0.02 * w.model["v_max"]
    middle, wide = np.clip(expected, w.low, w.high), w.high - w.low > 4.0 * reach
    low, high = np.maximum(w.low, middle - reach), np.minimum(w.high, middle + reach)
    return np.where(wide, low, w.low), np.where(wide, high, w.high), wide.any()


@pytest.mark.parametrize(
    ("kind", "n"), [("still", 7), ("everything", 8), ("crowd", 8), ("everything", 3), ("still", 1)]
)
def test_rows_are_looked_for_where_the_answer_is_expected(kind, n):
    """The trust region is around the nominal control, or around the last control if rows were binding; else the box."""
    rng, seen = np.random.default_rng(17), [0, 0, 0, 0]
    for _ in range(60):
        found = run_both(rng, n, 6, kind)
        if found is None or found[3].status > 1:
            continue
        made, model, m, answer, got, w = found
        for turn in range(2):
            bound = got["step"]["n_warm"][0] > 0
            low, high, narrowed = around(w, m.u_prev if turn and bound else m.u_nom)
            values = got["step"]["trust_active"][0]
            assert values in (0, narrowed)
            inside = np.all((answer.u >= low) & (answer.u <= high))
            found_there = np.all((answer.u >= w.trust_low) & (answer.u <= w.trust_high))
            assert found_there or not values, "a result outside the trust region must not be reported as inside"
            well_inside = np.all((answer.u > low + 1e-6) & (answer.u < high - 1e-6))
            assert values or not (narrowed and well_inside), "a result well inside must be found in the trust region"
            if values and inside:
                close(w.trust_low, low, "trust region")
                close(w.trust_high, high, "trust region")
                seen[2 * turn + int(bound)] += 1
            if not values:
                close(w.trust_low, w.low, "the whole box")
                close(w.trust_high, w.high, "the whole box")
            was_bound, m.u_prev = bound, np.array(answer.u)
            answer = random_cases.run_step(made, m)
            got = random_cases.step_internals(made, n, 6)
            got["step"]["n_warm"] = np.array([float(was_bound)])
            if answer.status > 1:
                break
            box, trust = (
                (got["step"][a][:n], got["step"][b][:n])
                for a, b in (("lower", "upper"), ("trust_lower", "trust_upper"))
            )
            w = ReferenceRows(model, m, box, trust)
    assert sum(seen) > 3, seen
