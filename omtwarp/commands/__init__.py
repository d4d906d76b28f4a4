"""The commands of the command line, one module each; :mod:`omtwarp.commands._cli` puts them together.

Nothing heavy is imported at the top of these modules, so that ``omtwarp --help`` answers at once.
"""
