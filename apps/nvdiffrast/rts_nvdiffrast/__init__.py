"""The interface of nvdiffrast's torch module, on rts: `import rts_nvdiffrast.torch as dr`."""

import rts as rts  # Before torch, whose idle threads it asks not to spin.
