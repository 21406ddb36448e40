"""The interface of nvdiffrast's torch module, on rts: `import rts_nvdiffrast.torch as dr`."""
