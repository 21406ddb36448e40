"""The interfaces of plugins: a base class for each kind, and the records that pass between them."""
