"""Algorithm 2: how a model is adapted on robots, and planned with.

Read in this order:

1. ``controller``: the algorithm from top to bottom, and what varies in it, the
   :class:`~famle_agent.adaptation.controller.Adapter`.
2. ``adapters``: FAMLE's adapter, and that of the agents without embeddings.
3. ``candidates``, ``posterior``: which embeddings there are to select from, and how likely each is (line 2). The
   equations of the filter are in ``posterior``.
4. ``update``: selecting an embedding (line 2) and gradient steps (line 3).
5. ``state``, made of ``belief``, ``memory``, ``library`` and more: what robots carry from step to step, as values.
6. ``settings``: all that can be chosen of the above.

Around it, ``perception`` and ``senses`` keep out what cannot be a measurement, ``guide`` proposes plans (line 4),
``diagnosis`` says in words what the posterior says, and ``experience`` is what became of a step.
"""
