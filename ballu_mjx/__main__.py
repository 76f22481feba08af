"""`python -m ballu_mjx`: which commands there are, in the order of the work."""

COMMANDS = (
    ("recording", "record import FILE", "make a recording from a Vicon CSV, a C3D or any table"),
    ("", "record check FILE", "what is in a recording, and what is wrong with it"),
    ("", "record simulate", "record on the virtual robot"),
    ("identification", "train sysid", "actuator parameters from a suspended sweep"),
    ("residual", "train envmimic", "forces that make simulation follow recordings"),
    ("", "evaluate RUN", "replay recordings without and with these forces"),
    ("policy", "train walk", "also turn, turn-right, walk-backward: policies in an improved simulator"),
    ("everything", "train all", "the whole story on a virtual robot"),
    ("looking", "report RUN", "a run as one page for the browser, with a replay in 3D"),
    ("", "view RUN", "the replay, or a recording, live"),
    ("", "compare RUN RUN ...", "runs side by side, mean and interval over seeds"),
    ("the robot", "export RUN", "a policy as a controller that needs NumPy alone"),
)
"""Stage, what follows `python -m ballu_mjx.`, what it is for."""


def main() -> None:
    """Print the commands by stage."""
    print("Commands, each after `python -m ballu_mjx.`; --help explains one, `train ... --quick` shows it at work.\n")
    for stage, command, purpose in COMMANDS:
        print(f"  {stage:15} {command:20} {purpose}")


if __name__ == "__main__":
    main()
