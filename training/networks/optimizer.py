"""The training loop: AdamW with clipped gradients; the result is a running mean of the weights.

Sources: Loshchilov and Hutter 2019, "Decoupled weight decay regularization" (AdamW); Shamir and
Zhang 2013, "Stochastic gradient descent for non-smooth optimization: convergence results and
optimal averaging schemes" (the mean, in which late weights count more).

    m(0) = v(0),  m(n) = m(n - 1) + (e + 1) / (n + e + 2) * (v(n) - m(n - 1))

v are the weights after a step, m their mean, and e is its exponent.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel

from kouxing.training.training_set import Report

SAVE_EVERY = 25  # steps
MIN_SAVE_S = 30.0  # between two saves

N = TypeVar("N", bound=nn.Module)
_Tensors: TypeAlias = tuple[Tensor, ...] | list[Tensor]


class Optimizer(Generic[N]):
    """Trains a network in place.

    ``groups`` are parameter groups with their learning rates, as for ``torch.optim``.
    ``mean_exponent`` is the e of the running mean.
    """

    def __init__(
        self,
        network: N,
        groups: Sequence[dict[str, Any]],
        *,
        weight_decay: float,
        max_norm: float,
        mean_exponent: int,
    ) -> None:
        self._network = network
        self._averaged = AveragedModel(network, multi_avg_fn=_weight_average(mean_exponent))
        self._averaged.eval()
        self._adam = torch.optim.AdamW(groups, weight_decay=weight_decay)
        self._rates = [group["lr"] for group in self._adam.param_groups]
        self._max_norm = max_norm

    def train(
        self,
        loss_of: Callable[[int], Tensor],
        rate_factor_of: Callable[[int], float],
        *,
        num_steps: int,
        seed: int,
        report: Report,
        checkpoint: Path | None = None,
    ) -> N:
        """Train, and return the network with the running mean of the weights.

        ``loss_of`` computes the loss of a step. It may itself add gradients of parts of the loss.
        ``rate_factor_of`` computes the factor of the learning rates. Each step has its own random
        state. The state is saved in ``checkpoint``, and training resumes from this file if it
        exists.
        """
        first_step = self._load(checkpoint) if checkpoint and checkpoint.exists() else 0
        if first_step:
            report(f"resuming after step {first_step}")
        losses = []
        next_save_s = time.monotonic() + MIN_SAVE_S
        for step in range(first_step, num_steps):
            torch.manual_seed(seed + step)
            self._adam.zero_grad()
            loss = loss_of(step)
            self._step(loss, rate_factor_of(step))
            losses.append(loss.detach())
            if (step + 1) % SAVE_EVERY == 0 or step + 1 == num_steps:
                report(f"step {step + 1}: loss {torch.stack(losses).mean():.3f}")
                losses = []
                if checkpoint and (time.monotonic() >= next_save_s or step + 1 == num_steps):
                    self._save(checkpoint, step + 1)
                    next_save_s = time.monotonic() + MIN_SAVE_S
        return cast(N, self._averaged.module).eval()

    def _step(self, loss: Tensor, rate_factor: float) -> None:
        for group, rate in zip(self._adam.param_groups, self._rates, strict=True):
            group["lr"] = rate_factor * rate
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._network.parameters(), self._max_norm)
        self._adam.step()
        self._averaged.update_parameters(self._network)

    def _save(self, checkpoint: Path, num_steps: int) -> None:
        state = {name: part.state_dict() for name, part in self._parts().items()}
        unfinished = checkpoint.with_suffix(".part")
        torch.save(state | {"num_steps": num_steps}, unfinished)
        unfinished.replace(checkpoint)

    def _load(self, checkpoint: Path) -> int:
        """Restore the state; return the number of steps taken."""
        state = torch.load(checkpoint, map_location="cpu", weights_only=True)
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        return int(state["num_steps"])

    def _parts(self) -> dict[str, Any]:
        return {"network": self._network, "averaged": self._averaged, "optimizer": self._adam}


def warm_up_factor(step: int, num_steps: int) -> float:
    """Learning-rate factor: a linear rise during the first steps."""
    return min(1.0, (step + 1) / num_steps)


def warm_up_and_decay_factor(
    step: int, num_steps: int, warm_up_steps: int, falling: float
) -> float:
    """Learning-rate factor: a linear rise, and a fall to 0 in the last fraction of the steps."""
    rise = warm_up_factor(step, warm_up_steps)
    return rise * min(1.0, (num_steps - step) / (falling * num_steps))


def cross_entropy(log_posteriors: Tensor, states: Tensor, probs: Tensor) -> Tensor:
    """Mean cross-entropy over the frames with targets, nats.

    ``log_posteriors`` have the shape (..., states), target ``states`` and their ``probs`` (..., k).
    """
    return -(log_posteriors.gather(-1, states) * probs).sum() / probs.sum().clamp(min=1.0)


def _weight_average(exponent: int) -> Callable[[_Tensors, _Tensors, Tensor | int], None]:
    def update(means: _Tensors, weights: _Tensors, num_before: Tensor | int) -> None:
        factor: Any = (exponent + 1) / (num_before + exponent + 2)  # a tensor stays on its device
        torch._foreach_lerp_(means, weights, [factor] * len(means))

    return update
