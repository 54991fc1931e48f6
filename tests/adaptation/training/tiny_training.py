"""Training runs of the tiny model: alone, interrupted, or in several processes."""

from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.curation.dataset import Dataset, DatasetCard
from dualbrain.adaptation.curation.sample import Sample, assistant_turn
from dualbrain.adaptation.training.process_group import SINGLE_PROCESS
from dualbrain.adaptation.training.trainer import BEST_FILE, CHECKPOINT_FILE, STATES_FILE, Trainer
from tests.adaptation.tiny_model import TRAINING_CONFIG, lora_model

ANSWERS = ("grasp cup", "place", "push tin", "go home")
DEFAULT_CONFIG = AdaptConfig(fit=TRAINING_CONFIG)


def exact_match(text, sample):
    return text == sample.contract


def sample(number, contract=None):
    answer = ANSWERS[number % 4] if contract is None else contract
    turns = [{"role": "user", "content": f"do {number}"}]
    return Sample(
        id=f"s{number}",
        prompt=turns,
        completion=assistant_turn(answer),
        weight=number % 3 / 2,
        Delta=0.0,
        duration=1.0,
        repeats=1 + number % 2,
        scene=f"g{number}",
        memory=f"m{number}",
        events=(number,),
        source="a test",
        graspable=(),
        receptive=(),
    )


def dataset(train=9, held_out=3, name="a"):
    rows = tuple(sample(i) for i in range(train + held_out))
    card = DatasetCard(
        hash=name,
        form="",
        robot="panda",
        registry="",
        prompt="",
        ledger="",
        event=0,
        memories=0,
        train=train,
        held_out=held_out,
        shown=0,
        scenes=0,
        merged=0,
        left_out={},
        sources={},
        epsilon=0.0,
        slowest=1.5,
        most_repeats=4,
        share_held_out=0.2,
        salt="",
    )
    return Dataset(card, rows[:train], rows[train:])


@dataclass
class TinyTraining:
    """A training run of a tiny model in `folder`."""

    folder: Path
    data: Dataset = field(default_factory=dataset)
    config: AdaptConfig = DEFAULT_CONFIG
    judge: object = exact_match
    clock: object = lambda: 0.0
    process_group: object = SINGLE_PROCESS

    def __post_init__(self):
        self.folder.mkdir(exist_ok=True)
        self.lora_model = lora_model(self.config.fit)
        self.trainer = Trainer(
            self.lora_model,
            self.data,
            self.config,
            self.judge,
            self.folder,
            base="base",
            clock=self.clock,
            process_group=self.process_group,
        )

    def run(self, report=lambda progress: None):
        return self.trainer.run(report)

    def output_files(self):
        """The bytes of all files of the run; nothing incomplete is left."""
        names = {path.name for path in self.folder.iterdir()}
        assert names == {CHECKPOINT_FILE, BEST_FILE, STATES_FILE}
        return {name: (self.folder / name).read_bytes() for name in names}


def config_with(**changed):
    return AdaptConfig(fit=msgspec.structs.replace(TRAINING_CONFIG, **changed))
