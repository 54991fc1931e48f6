"""Vocabulary of the goal parser: verbs, prepositions, quantifiers, and words that do not change a goal."""

from __future__ import annotations

from dualbrain.grounding.instruction.goal import Relation

PLACING_VERBS = (
    "put|place|move|set|drop|bring|stand|lay|transfer|carry|take|get|deposit|shift|stow|pop|stick|collect|gather|"
    "sort|throw|tidy|drag|transport|insert|position|return|leave|stack|bring over|put away"
)
"""Verbs of a placement; with a destination none of them says how the object gets there."""
LIFTING_VERBS = "pick up|pick|grasp|grab|lift up|lift|take|hold up|hold|raise|get hold of|fetch"
HANDING_VERBS = "hand|give|pass|bring|hand over|fetch|get"
PUSHING_VERBS = "push|shove|slide|nudge"
OBSERVING_PHRASES = (
    "look at|have a look at|hover over|hover above|point at|point to|check on|move above|move your hand above|"
    "hold your hand over|go over|go above|show me|inspect"
)
GERUNDS = {
    "putting": "put",
    "placing": "place",
    "moving": "move",
    "bringing": "bring",
    "taking": "take",
    "picking": "pick",
    "dropping": "drop",
    "handing": "hand",
    "giving": "give",
    "passing": "pass",
    "going": "go",
    "returning": "return",
    "lifting": "lift",
    "holding": "hold",
    "pushing": "push",
    "sliding": "slide",
    "setting": "set",
    "grasping": "grasp",
}
"""Gerunds after "would you mind", and their verbs."""
HAZARD_VERBS = frozenset(
    "hit hits punch slap kick stab smash crush break shatter squash destroy throw hurl fling pinch strangle attack hurt "
    "injure harm kill knock ram crash swing burn poke scare chase squeeze trip shove-person".split()
)
"""Verbs whose instruction could injure a person or damage an object. "throw X in Y" with a container is a placement."""
IMPOSSIBLE_VERBS = frozenset(
    "pour unscrew fold tie wash cut paint weigh open cook read write draw dry clean sing dance fly climb clone eat drink "
    "buy sell print calculate boil melt peel sew iron repair sweep mop dust vacuum photograph unwrap unlock assemble "
    "disassemble inflate".split()
)
"""Verbs that no skill of any robot carries out."""
UNAUTHORISED_PHRASES = (
    "safety filter",
    "safety layer",
    "collision avoidance",
    "emergency stop",
    "speed limit",
    "system prompt",
    "your rules",
    "all rules",
    "your memory",
    "keep-out",
    "the brakes",
    "the gatekeeper",
    "newest adapter",
    "previous instructions",
    "all instructions",
)
"""Parts of the robot that no instruction may change or reveal."""
PERSONS = frozenset("person man woman human child boy girl him her somebody someone people hand-of-person".split())
"""Words for people, whom no skill acts on."""

PREPOSITIONS: tuple[tuple[str, Relation], ...] = (
    (r"(?:to|on|at) the left(?:[- ]hand)?(?: side)? of|left of", "left_of"),
    (r"(?:to|on|at) the right(?:[- ]hand)?(?: side)? of|right of", "right_of"),
    (r"in front of|before", "in_front_of"),
    (r"behind|in back of", "behind"),
    (r"between", "between"),
    (r"next to|beside|besides|close to|near to|near|by|alongside|adjacent to|around", "near"),
    (r"on top of|onto|on|upon|atop", "on"),
    (r"into|inside(?: of)?|in", "in"),
    (r"under(?:neath)?|below|beneath", "under"),
    (r"above|over", "above"),
    (r"away from|far from", "away_from"),
    (r"off of|off|out of|from", "off"),
    (r"at|over to|to", "at"),
)
"""Prepositions of a placement and their relations; the first that matches counts."""

NUMBERS = {"one": 1, "two": 2, "three": 3, "four": 4, "five": 5, "six": 6, "1": 1, "2": 2, "3": 3, "4": 4, "5": 5}
DETERMINERS = frozenset("the a an that this those these my your its his our some any".split())
GENERIC_NOUNS = frozenset("thing object item one stuff piece".split())
"""Nouns that any object of the scene may be called by."""
COLOURS = frozenset(
    "red blue green yellow orange pink purple teal brown black white grey gray clear oak cyan magenta violet transparent "
    "silver gold beige turquoise".split()
)
NO_OBJECTS = frozenset(
    "table floor hand air time way arm gripper robot place here there where you me yourself myself is are was be on in at "
    "to of off from with without and or but if unless until while when once twice again first last then after before "
    "away back up down out over under left right side front top bottom middle other same another more less most few "
    "many much not no nothing anything something somewhere everywhere anywhere it them him her who what which how why "
    "please into onto near next as than like only also all each every both times half ones".split()
)
"""Words that are no part of the name of an object: a phrase with one of them is not the name of an absent object."""
SYNONYMS = (
    frozenset("cube block box brick carton die dice parcel package crate".split()),
    frozenset("tin can jar cylinder bottle flask".split()),
    frozenset("bowl dish container basket basin tray".split()),
    frozenset("glass cup tumbler beaker mug".split()),
)
"""Nouns that people use for the same object. A noun that is only a synonym of an object's category is not read."""

FILLERS = (
    r"please|kindly|carefully|gently|slowly|quickly|softly|cautiously|now|just|simply|immediately|straight|right away|"
    r"with care|for me|once more|over there|as well|too|thank you|thanks|hey|hello|hi|okay|ok|robot|for a moment|"
    r"take your time and|if you can|if you would|(?:but )?slowly and with care|without knocking anything over|"
    r"somebody may reach across the table|mind the people|but be careful|be careful|safely|directly"
)
"""Words that change neither the goal nor what may move."""
REQUESTS = (
    r"would you be so kind as to|please be so kind as to|be so kind as to|(?:could|would|can|will) you mind|"
    r"(?:could|would|can|will) you|i would like you to|i'd like you to|i want you to|i need you to|you should|"
    r"you have to|you must|let us|let's|go and|go ahead and|first of all|to begin with|first|start by|next|finally|"
    r"i ask you to|your task is to|try to"
)
"""Openings of a sentence that ask for what follows."""
HOME_CLAUSES = (
    r"(?:go|return|move|drive|come|get|travel|retreat)(?: the arm| your arm| yourself| back)*(?: to)?(?: the| your| its)?"
    r"(?: home| resting| rest| start| starting| initial| parking)+(?: posture| position| pose| place)?",
    r"(?:retract|park)(?: the| your)? (?:arm|robot)",
    r"go (?:back )?to where you (?:started|began|were)",
    r"go back to where you started",
    r"(?:go|return) (?:and|to) rest",
    r"rest|take a break|that is all for today",
    r"(?:get|move)(?: the arm| your arm)? out of (?:the|my) way(?:, back home)?",
    r"the arm should be at rest",
    r"we are done for now, go and rest",
    r"home",
)
STILL_CLAUSES = (
    r"stop(?: it| now| moving| at once| everything| the arm| the robot)*|halt|freeze|wait|pause|stay(?: where you are| there| still)*|"
    r"hold still|stand still|do(?: not|n't) move|do nothing|don't do anything|do not do anything|hold(?: on| it)?|"
    r"stay put|abort|cancel|whoa|enough",
)
