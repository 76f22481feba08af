"""Importers of motion capture files, which convert them to the format `ballu-recording/1`.

`readers` lists the file formats. A reader returns the parts that a `mapping` selects as `Trajectories`, in SI units and
the frame of the capture. Most readers first make a `capture`: the bodies and columns of the file by name. `placement`
converts trajectories to the model's sites in the frame of recordings. `draft` writes a first mapping for a file.
"""
