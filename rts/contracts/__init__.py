"""What plugins implement: a base class for each kind, and the records that pass between them."""
