"""FAMLE: Fast Adaptation through Meta-Learning Embeddings (Kaushik, Anne and Mouret, IROS 2020)."""

from __future__ import annotations

from collections.abc import Callable

from famle_agent.adaptation import Belief, Memory, adapt, prior
from famle_agent.agent import ModelBasedAgent
from famle_agent.dashboard import log_embeddings
from famle_agent.meta_learning import MetaStep
from famle_agent.transitions import Transitions

__all__ = ["FAMLE"]


class FAMLE(ModelBasedAgent):
    """Meta-learns one network and one embedding per situation in simulation; picks and adapts them on the robot.

    Arguments as for :class:`~famle_agent.simulation.SimulationLearner`.

    Example:
        >>> from famle_agent import FAMLE
        >>> agent = FAMLE("reacher", seed=0, meta_iterations=2, transitions_per_situation=50)
        >>> agent = agent.meta_learn()
        >>> agent.situations[:2]
        ('intact', 'joint 0 dead')
    """

    def _learn_model(self, transitions: Transitions, on_iteration: Callable[[dict[str, float]], bool]) -> None:
        """Algorithm 1: randomly initialised theta and H, and Reptile on both."""
        settings = self.hyperparameters
        obs, action, next_obs = self._tensors(transitions.obs, transitions.action, transitions.next_obs)
        self.dynamics = self._new_dynamics(n_situations=len(transitions.situations))
        self.dynamics.fit_normalisation(obs, next_obs)
        data = self.dynamics.encode(obs, action, next_obs)

        def log(step: MetaStep) -> bool:
            return on_iteration({"meta/loss_before": step.loss_before, "meta/loss_after": step.loss_after})

        settings.reptile()(self.dynamics, data, settings.inner_loop(), self._generator, log)
        self.dynamics.fit_noise(data)
        log_embeddings(self.logger, self.dynamics.embeddings, self.situations, self.num_timesteps)

    def _prior(self, robots: int) -> Belief:
        return prior(self._require_dynamics(), robots)

    def _adapt(self, memory: Memory, belief: Belief) -> Belief:
        """Algorithm 2, lines 6 and 7: the most likely embedding, then k gradient steps on theta and h."""
        return adapt(self._require_dynamics(), memory, self.hyperparameters.adaptation(), belief)
