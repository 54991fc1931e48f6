"""Plain fine-tuning with TRL as an oracle: its trainer and ours take the same steps."""

import pytest

pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")
trl = pytest.importorskip("trl", reason="TRL is for this comparison only")
datasets = pytest.importorskip("datasets", reason="TRL is for this comparison only")

import torch  # noqa: E402

from dualbrain.adaptation.training.master_weights import MasterWeights  # noqa: E402
from dualbrain.adaptation.training.model.batching import collate, contract_hidden_states  # noqa: E402
from dualbrain.adaptation.training.objective import objective  # noqa: E402
from tests.adaptation.tiny_model import lora_model, random_samples  # noqa: E402

STEPS, RATE = 5, 1e-2


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_without_lambda_and_beta_the_steps_equal_those_of_trl(tmp_path):
    """Each step has all four samples, so their order has no effect."""
    ours, theirs, some = lora_model(), lora_model(), random_samples(4)
    rows = [
        {"input_ids": [*one.prompt, *one.contract], "completion_mask": [0] * len(one.prompt) + [1] * len(one.contract)}
        for one in some
    ]
    training_arguments = trl.SFTConfig(
        output_dir=str(tmp_path),
        max_steps=STEPS,
        per_device_train_batch_size=4,
        learning_rate=RATE,
        weight_decay=0.0,
        lr_scheduler_type="constant",
        max_grad_norm=1e9,
        optim="adamw_torch",
        logging_steps=1,
        save_strategy="no",
        report_to="none",
        use_cpu=True,
        bf16=False,
        gradient_checkpointing=False,
        completion_only_loss=True,
    )
    trainer = trl.SFTTrainer(
        model=theirs.model,
        args=training_arguments,
        train_dataset=datasets.Dataset.from_list(rows),
        processing_class=theirs.tokenizer,
    )
    trainer.train()
    losses = [row["loss"] for row in trainer.state.log_history if "loss" in row]
    masters, batch = MasterWeights(ours.parameters), collate(some, ours.padding_id)
    for step in range(STEPS):
        hidden, labels = contract_hidden_states(ours.decoder, batch)
        loss = objective(hidden, ours.head, labels, torch.ones(len(labels)), len(labels)).total
        loss.backward()
        masters.step(RATE, clip=1e9)
        assert float(loss.detach()) == pytest.approx(losses[step], rel=1e-3)
    for name, parameter in ours.parameters.items():
        torch.testing.assert_close(parameter, theirs.parameters[name].to(parameter), rtol=1e-2, atol=1e-4)
