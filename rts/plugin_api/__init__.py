"""The home of plugins: all that one imports, in submodules, each loaded when imported.

`from rts.plugin_api.bases import Surface`, for example. `docs/plugins.md` lists the names of each submodule.
"""
