"""A name of earlier versions: whoever imports it is told where its functions are now."""

import rts

try:
    getattr(rts, __name__.rpartition(".")[2])
except AttributeError as error:
    raise ImportError(str(error)) from None
