"""Importers: from what a laboratory has (Vicon CSV, C3D, tables, command logs) to `ballu-recording/1`.

Each format's module gives `Trajectories` in SI units and the capture's own frame; `placement` turns them into the
model's sites in the format's frame, by a `mapping` file that says what is what.
"""
