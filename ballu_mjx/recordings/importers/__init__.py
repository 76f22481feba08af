"""Importers: from what a laboratory has to `ballu-recording/1`.

`readers` lists the formats. Each gives what a `mapping` asks for as `Trajectories`, in SI units and the capture's own
frame; most do so by a `capture`, the file's bodies and columns by name. `placement` turns trajectories into the model's
sites in the format's frame. `draft` writes a first mapping for a file.
"""
