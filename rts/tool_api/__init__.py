"""Names for tools: packages that run, test and measure the library, such as its own command, in submodules.

Plugins import `rts.plugin_api`. `from rts.tool_api.files import writing`, for example: each submodule is loaded when it
is imported.
"""
