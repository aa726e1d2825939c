"""One engine of hypotheses over a finished fit: what may be wrong beside the model's parameters, and what that costs.

docs/explanation/hypotheses.md derives every formula. The way through the modules:

1. ``whitened``: the fit's rows, divided by the declared noise, with their derivatives by everything that can be off.
2. ``catalogue``: the hypotheses, each a few columns with candidates.
3. ``evidence``: the weight of each candidate in the residuals, and the probability of chance.
4. ``noise``: kernels for residuals that are not what was declared.
5. ``search``: the most probable hypothesis, its rivals, and again with it as a parameter; its gain in left-out rows.
6. ``averaging``: the stated error of the tool, averaged over the hypotheses.
7. ``examination``: all of this for an estimate.

A fit far off has wrong inputs. ``inputs`` decides when to look for them: ``alternatives`` and ``labels`` transform
table and rig, ``trial`` compares quick fits.
"""
