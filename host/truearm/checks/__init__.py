"""One engine of hypotheses over a finished fit: what may be wrong beside the model's parameters, and what that costs.

docs/explanation/hypotheses.md derives every formula. The way through the modules:

1. ``whitened``: the fit's rows, divided by the declared noise, with their derivatives by everything that can be off.
2. ``catalogue``: the list of hypotheses, each a few columns with candidates (rows from which, or profiles over the rows).
3. ``evidence``: the weight of each candidate in the residuals, and the probability of chance.
4. ``noise``: kernels for residuals that are not what was declared.
5. ``search``: the most probable hypothesis, its rivals, and the same again with it as a parameter; ``held_out``: what it
   gives in rows that were left out.
6. ``averaging``: the stated error of the tool, averaged over the hypotheses.
7. ``examination``: all of this for an estimate.

A fit that is so far off that first order does not apply has wrong inputs. ``inputs`` decides when to look for them:
``alternatives`` and ``labels`` transform table and rig, ``trial`` compares quick fits of them.
"""
