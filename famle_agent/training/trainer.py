"""Algorithm 1 of the paper: transitions of N situations become theta_meta and H_meta.

Its lines are in several files, through which ``famle_agent.agents.meta_training`` goes in this order:

    1 to 6   transitions D_c of each situation c     famle_agent.data.collect
    7, 8     theta and H before they are learnt      famle_agent.agents.meta_training, begin_model
    9 to 14  theta_meta and H_meta, by Reptile       famle_agent.training.reptile

Here is what learns: joint training, which the paper does not have, and then the meta-learner, Reptile or MAML.

Training is a generator of metrics: whoever wants to log, stop or show a bar does it outside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

from famle_agent.models.dynamics import Batch, Dynamics
from famle_agent.models.gradient_steps import InnerLoop
from famle_agent.training.maml import MAML
from famle_agent.training.multitask import JointTraining
from famle_agent.training.progress import Progress
from famle_agent.training.reptile import Reptile

__all__ = ["MetaTrainer", "Metrics"]

Metrics = dict[str, float]
"""What an iteration has to report, by name."""


@dataclass(frozen=True)
class MetaTrainer:
    """Trains a model on all situations at once, and meta-learns from there.

    Attributes:
        joint: Training on all situations at once; None is the paper's.
        meta_learner: Reptile, which is Algorithm 1, or MAML; None leaves it at the joint training.
        inner_loop: U^k of the meta-learner; None without one.

    Raises:
        ValueError: There is a meta-learner without an inner loop.
    """

    joint: JointTraining | None
    meta_learner: Reptile | MAML | None
    inner_loop: InnerLoop | None

    def __post_init__(self) -> None:
        if self.meta_learner is not None and self.inner_loop is None:
            raise ValueError("A meta-learner takes gradient steps; give it an inner_loop.")

    @property
    def iterations(self) -> int:
        """How many iterations there are."""
        return sum(learner.iterations for learner in (self.joint, self.meta_learner) if learner is not None)

    def fit(
        self,
        model: Dynamics,
        data: Batch,
        generator: torch.Generator,
        progress: Callable[[str], Progress] = lambda stage: Progress(),
    ) -> Iterator[Metrics]:
        """Trains ``model`` in place, and fits its noise in the end, be it reached or not.

        Args:
            model: Its theta and embeddings become theta_meta and H_meta.
            data: Encoded transitions of the N situations.
            generator: Source of all the chance.
            progress: Where a stage, given its name, goes on from.

        Yields:
            The losses of each iteration.
        """
        try:
            if self.joint is not None:
                for loss in self.joint.steps(model, data, generator, progress("joint")):
                    yield {"meta/joint_loss": loss}
            if self.meta_learner is not None and self.inner_loop is not None:
                for step in self.meta_learner.steps(model, data, self.inner_loop, generator, progress("meta")):
                    yield {"meta/loss_before": step.loss_before, "meta/loss_after": step.loss_after}
        finally:
            model.fit_noise(data)
