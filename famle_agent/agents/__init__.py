"""FAMLE and its baselines, with the face of Stable-Baselines3.

- An agent: ``agent`` is the class that users see, for the robot; ``meta_learning_agent`` is its part for the
  simulation (Algorithm 1), and ``stored_agent`` its part for files. ``famle`` and ``baselines`` name their adapters.
- Algorithm 1: ``meta_training`` goes round by round; ``world_model`` is what comes of it, and ``check`` tries that.
- Algorithm 2: ``policy`` puts the parts of :mod:`famle_agent.adaptation` together, as the settings say;
  ``online_adaptation`` carries their state from step to step. ``wrapper`` is the loop of somebody else's robot.
- Settings: ``config``, made of flat ``keywords``; ``presets`` has those of each robot.
- Files: ``checkpoint`` is what they hold, and ``parameters`` the weights alone.

What is written of an agent while it lives on robots is in :mod:`famle_agent.monitoring`.
"""
