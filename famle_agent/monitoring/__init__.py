"""What is written of an agent on its robots, to Stable-Baselines3's logger and to TensorBoard.

- ``logs`` has the scalars that Stable-Baselines3 names.
- ``adaptation_log`` shows a robot within its episode, with ``held_out``, the errors of predictions, and ``pictures``.
- ``tensorboard`` writes what Stable-Baselines3's logger cannot.

None of them imports an agent; ``logged_agent`` says what they ask of one.
"""
