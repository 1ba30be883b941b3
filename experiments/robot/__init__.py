"""The paper's experiments on a robot, on a simulated arm of the same make."""
