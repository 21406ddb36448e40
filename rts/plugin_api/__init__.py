"""The toolkit of plugins: submodules that a plugin may import beside `rts`, each loaded when imported.

`from rts.plugin_api.arrays import unit`, for example. `docs/plugins.md` lists the names of each submodule.
"""
