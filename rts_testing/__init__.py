"""The conformance kit of plugins, whose classes `rts.testing` names."""
