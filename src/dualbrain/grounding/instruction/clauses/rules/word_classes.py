"""Classes of words as alternatives of a regular expression: numbers, units, people, things, and verbs of motion."""

NUMBER = (
    r"(?:\d+(?:[.,]\d+)?|two|three|four|five|six|seven|eight|nine|ten|eleven|twelve|fifteen|twenty|thirty|forty|fifty"
    r"|sixty|ninety|hundred)"
)
AMOUNT = rf"(?:{NUMBER}|an?|one|half an?|a few|several|some|a couple of|a dozen|few|couple of)"
TIME_UNIT = r"(?:s|secs?|seconds?|mins?|minutes?|h|hours?|days?|weeks?)"
PARAMETER_UNIT = (
    r"(?:mm|cm|dm|m|n|rad|newtons?|radians?|degrees?|percent|%|millimet(?:er|re)s?"
    r"|centimet(?:er|re)s?|met(?:er|re)s?)"
)
"""Units of the numbers that a skill takes, and of the limits that an instruction states for them."""
LENGTH_UNIT = (
    r"(?:mm|cm|dm|m|millimet(?:er|re)s?|centimet(?:er|re)s?|met(?:er|re)s?|inch(?:es)?|foot|feet|steps?|yards?|hands?"
    r"|fingers?|palms?)"
)
PEOPLE = (
    r"(?:i|we|he|she|they|you|me|us|him|her|somebody|someone|anyone|anybody|everyone|everybody|nobody|no one|people"
    r"|(?:the|a|that|this|my) (?:person|people|man|woman|human|child|kid|user|operator|visitor|worker|colleague|guest"
    r"|customer|sister|brother|mother|father|boss|friend))"
)
PERSON = (
    r"(?:persons?|people|man|woman|human|child|children|kids?|user|operator|visitor|worker|colleagues?|coworker|guests?"
    r"|customer|client|patient|nurse|doctor|surgeon|cook|chef|boss|driver|neighbou?r|lady|gentleman|guy|girl|boy|baby"
    r"|student|teacher|technician|engineer|supervisor|manager|assistant|friends?|sister|brother|mother|father"
    r"|mum|mom|dad"
    r"|wife|husband|partner|daughter|son|grandma|grandpa|aunt|uncle|cousin|owner|team|crew|waiter)"
)
THINGS = (
    r"(?:things|objects|items|pieces|ones|blocks|cubes|cans|tins|boxes|cartons|bottles|glasses|parcels|crates|cups"
    r"|mugs|toys|tools|packages|balls|bricks|jars)"
)
THING = "block|cube|can|tin|box|carton|bottle|glass|parcel|crate|cup|mug|toy|ball|brick|jar|object|thing"
"""Alternatives for one object that the hand can hold."""
MOVE = (
    r"(?:put|place|set|move|drop|lay|stand|push|slide|shove|nudge|shift|leave|bring|park|position|rest|store|stow"
    r"|go|drive|stop|come|hover|hold|point|release|turn|place it|deposit|keep|pull|drag|roll|transfer"
    r"|carry|wait|stay|want|like|should|belongs?)"
)
PUSHES = r"\b(?:push|shove|slide|nudge|pushing|shoving|sliding)\b"
CLOSER_BY_PUSH = (
    r"\b(?:push|shove|slide|nudge)\b.{0,60}\bcloser\b|\bcloser to the\b.{0,60}\b(?:pick|lift)\b"
    r"|\bhand ?(?:'s|s)? breadth closer\b"
)
