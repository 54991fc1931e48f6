"""Questions and the sections that answer them, written before any ranking was seen; some have several answers."""

QUESTIONS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("what should I do if the requested object is missing", ("site-rules/When to decline",)),
    ("can the robot throw a ball into the bin", ("site-rules/When to decline",)),
    ("somebody tells me to turn off the safety filter", ("site-rules/When to decline",)),
    ("how fast may the tool move normally", ("site-rules/Speed",)),
    ("which velocity when a user asks for care", ("site-rules/Speed",)),
    (
        "a worker reaches over the table, may the arm continue",
        ("site-rules/People at the table", "people-and-shared-space/Crossing: wait until clear"),
    ),
    ("after an emergency halt, may I resume by myself", ("site-rules/People at the table",)),
    (
        "how much force for a glass cup",
        ("site-rules/Fragile things", "grasping-guide/Opening and force", "panda-hand/Care"),
    ),
    (
        "may a porcelain plate be dropped into a container",
        ("site-rules/Fragile things", "grasping-guide/Placing into a bowl or box"),
    ),
    ("how far from the border of the table must things be put", ("site-rules/Table edges",)),
    ("is it allowed to stack blocks", ("site-rules/Tidiness and the end of work",)),
    ("what happens to the arm when the job is finished", ("site-rules/Tidiness and the end of work",)),
    ("may it move at night when nobody is there", ("site-rules/Night and absence",)),
    ("how heavy an object can the Panda lift", ("panda-hand/The arm",)),
    ("maximum finger opening of the gripper", ("panda-hand/The hand", "grasping-guide/Opening and force")),
    ("is a thin flat card graspable from above", ("panda-hand/The hand",)),
    ("does the hand notice that an object slips", ("panda-hand/Feeling",)),
    ("where is the hand in the resting posture", ("panda-hand/Home",)),
    ("range of comfortable workspace in front of the Franka", ("panda-hand/The arm",)),
    ("payload of the UR5e", ("ur5e-notes/The arm", "ur5e-notes/Tools")),
    ("when is the wrist of the universal robot singular", ("ur5e-notes/Singular postures",)),
    ("what to do after a protective stop", ("ur5e-notes/Stops",)),
    ("can the built-in force sensor weigh a letter", ("ur5e-notes/Tools",)),
    ("how far can the UR5e reach comfortably over the table", ("ur5e-notes/Where to work", "ur5e-notes/The arm")),
    ("can the mobile base move sideways", ("differential-base/How it moves",)),
    ("how to approach the dock with the base", ("differential-base/Driving to a place", "room-map/charging_dock")),
    ("braking distance at half a metre per second", ("differential-base/Stopping",)),
    ("how wide must a door be for the robot to pass", ("differential-base/Regions of the floor",)),
    ("may the base push a box out of the way", ("differential-base/Pushing and carrying",)),
    ("when should the battery be charged", ("differential-base/Charging",)),
    ("wheels slipping on a wet floor", ("differential-base/Slip",)),
    ("steepest ramp for the base", ("differential-base/Regions of the floor",)),
    ("fingers along or across a long stick", ("grasping-guide/Choosing the finger axis",)),
    ("when should I lean the hand instead of coming straight down", ("grasping-guide/Choosing the approach",)),
    (
        "how high to travel when a tall bottle stands on the path",
        ("grasping-guide/Choosing the clearance", "panda-templates/fetch_over_something_tall"),
    ),
    (
        "which route below a shelf",
        (
            "grasping-guide/Choosing the route",
            "panda-templates/fetch_below_a_shelf",
            "grasping-guide/Choosing the clearance",
        ),
    ),
    ("releasing an object above the rim of a bowl", ("grasping-guide/Placing into a bowl or box",)),
    ("where should a cylinder that may roll be put down", ("grasping-guide/Placing on a spot",)),
    ("the gripper closed on nothing, what now", ("grasping-guide/When a grasp failed", "panda-hand/Feeling")),
    (
        "in which order should several objects be moved",
        ("grasping-guide/Order of several things", "panda-templates/take_two_things"),
    ),
    ("may I hand an object directly to a human", ("people-and-shared-space/Handing over",)),
    (
        "carrying a knife close to a colleague",
        ("people-and-shared-space/Sharp, hot, heavy", "site-rules/When to decline"),
    ),
    ("the robot touched someone, what next", ("people-and-shared-space/After contact",)),
    ("a kid comes near the arm", ("people-and-shared-space/Children, visitors, animals",)),
    ("how is the safe distance to a person computed", ("people-and-shared-space/Separation",)),
    ("fingers squeezed between gripper and table", ("people-and-shared-space/Pinching",)),
    ("a person sits nearby and does not move", ("people-and-shared-space/Near: slow and predictable",)),
    ("where do broken parts go", ("room-map/reject_corner",)),
    ("where does the base stand to serve the table", ("room-map/table_front",)),
    ("where are the stairs", ("room-map/stair_head", "differential-base/Regions of the floor")),
    ("which part of the floor may be driven on", ("room-map/hall_floor", "differential-base/Regions of the floor")),
    ("contract for carrying something breakable slowly", ("panda-templates/carry_fragile",)),
    ("template for moving an object while a person crosses", ("panda-templates/fetch_past_a_person",)),
    ("just have a look at the item from above", ("panda-templates/look_from_above",)),
)

OFF_TOPIC_QUESTIONS = (
    "who won the world cup in 1998",
    "recipe for tomato soup",
    "capital of France",
    "translate good morning into Spanish",
    "price of bitcoin today",
    "lyrics of a love song",
    "integral of x squared",
    "weather forecast for Tuesday",
    "best novel of the nineteenth century",
    "how do vaccines work",
    "football training for children in winter",
    "configure nginx as a reverse proxy",
)
"""Questions that the built-in documents do not answer."""


def section_name(document: str, path: tuple[str, ...]) -> str:
    """The name of a section in the answers: document and innermost heading."""
    return f"{document}/{path[-1] if path else ''}"
