"""Settings, from the command line to a checked config.

`arguments` rewrites what users type for Hydra, `composition` composes the config with the options of `conf/`, which
`options` and `help` explain, `extensions` finds those of installed packages, and `checks` holds each setting against
`schema`.
"""
