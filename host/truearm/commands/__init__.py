"""The commands of ``truearm``: a module for each, with one function of the command's name, and what they share.

The top of a command's module imports typer, the standard library and ``truearm.errors`` only; what is slow to import
(numpy, scipy, rich) is imported by the function that needs it, so that ``truearm --help`` stays quick.
"""
