"""The training loop: AdamW with clipped gradients; the result is a running mean of the weights.

Sources: Loshchilov and Hutter 2019, "Decoupled weight decay regularization" (AdamW); Shamir and
Zhang 2013, "Stochastic gradient descent for non-smooth optimization: convergence results and
optimal averaging schemes" (the mean, in which late weights count more).

    m(0) = v(0),  m(n) = m(n - 1) + 9 / (n + 10) * (v(n) - m(n - 1))

v are the weights after a step, and m is their mean. The learning rates rise during the first steps,
stay constant, and fall to 0 at the end.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from kouxing.shared.command.terminal import print_message
from kouxing.training.seed import SEED

SAVE_EVERY = 25  # steps
MIN_SAVE_S = 30.0  # between two saves
_MEAN_EXPONENT = 8

N = TypeVar("N", bound=nn.Module)


def optimize(
    network: N,
    groups: Sequence[dict[str, Any]],
    losses_of: Callable[[int], Iterable[Tensor]],
    *,
    num_steps: int,
    warm_up_steps: int,
    decay_fraction: float,
    weight_decay: float = 0.01,
    max_norm: float = 2.0,
    checkpoint: Path | None = None,
) -> N:
    """Train a network in place; return one with the running mean of the weights.

    ``groups`` are parameter groups with their learning rates, as for ``torch.optim``. ``losses_of``
    yields the parts of the loss of a step. The gradients of a part are added before the next part
    is computed, so only one part needs memory. The rates fall during ``decay_fraction`` of the
    steps, at the end. Each step has its own random state. The state is saved in ``checkpoint``, and
    training resumes from this file if it exists.
    """
    averaged = AveragedModel(network, avg_fn=_average)
    averaged.eval()
    adam = torch.optim.AdamW(groups, weight_decay=weight_decay)
    rates = [group["lr"] for group in adam.param_groups]
    saved = {"network": network, "averaged": averaged, "optimizer": adam}
    first_step = _load(checkpoint, saved) if checkpoint and checkpoint.exists() else 0
    if first_step:
        print_message(f"resuming after step {first_step}")
    losses = []
    next_save_s = time.monotonic() + MIN_SAVE_S
    for step in range(first_step, num_steps):
        torch.manual_seed(SEED + step)
        adam.zero_grad()
        parts = []
        for part in losses_of(step):
            part.backward()  # type: ignore[no-untyped-call]
            parts.append(part.detach())
        rise = min(1.0, (step + 1) / warm_up_steps)
        factor = rise * min(1.0, (num_steps - step) / (decay_fraction * num_steps))
        for group, rate in zip(adam.param_groups, rates, strict=True):
            group["lr"] = factor * rate
        nn.utils.clip_grad_norm_(network.parameters(), max_norm)
        adam.step()
        averaged.update_parameters(network)
        losses.append(torch.stack(parts).sum())
        if (step + 1) % SAVE_EVERY == 0 or step + 1 == num_steps:
            print_message(f"step {step + 1}: loss {torch.stack(losses).mean():.3f}")
            losses = []
            if checkpoint and (time.monotonic() >= next_save_s or step + 1 == num_steps):
                _save(checkpoint, saved, step + 1)
                next_save_s = time.monotonic() + MIN_SAVE_S
    return cast(N, averaged.module).eval()


def cross_entropy(log_posteriors: Tensor, states: Tensor, probs: Tensor) -> Tensor:
    """Mean cross-entropy over the frames with targets, nats.

    ``log_posteriors`` have the shape (..., states), target ``states`` and their ``probs`` (..., k).
    """
    return -(log_posteriors.gather(-1, states) * probs).sum() / probs.sum().clamp(min=1.0)


def _save(checkpoint: Path, parts: dict[str, Any], num_steps: int) -> None:
    state = {name: part.state_dict() for name, part in parts.items()}
    unfinished = checkpoint.with_suffix(".part")
    torch.save(state | {"num_steps": num_steps}, unfinished)
    unfinished.replace(checkpoint)


def _load(checkpoint: Path, parts: dict[str, Any]) -> int:
    """Restore the state; return the number of steps taken."""
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    for name, part in parts.items():
        part.load_state_dict(state[name])
    return int(state["num_steps"])


def _average(mean: Tensor, weight: Tensor, num_before: Tensor | int) -> Tensor:
    # a tensor stays on its device
    factor: Any = (_MEAN_EXPONENT + 1) / (num_before + _MEAN_EXPONENT + 2)
    return torch.lerp(mean, weight, factor)
