"""The toolkit of plugins: all that a plugin may import beside the names of `rts`, in submodules loaded one by one.

`from rts.plugin_api.arrays import unit`, for example. `docs/plugins.md` has a line for each name.
"""
