"""Tables and rigs of a laser tracker with three targets on a robot's end, for recipes that need an identification."""

TARGETS = {"a": (0.0, 0.0, 0.1), "b": (0.1, 0.0, 0.0), "c": (0.0, 0.1, 0.05)}  # m, in the end frame
TRACKER = """
[[tracker]]
name = "t"
sigma_mm = [0.02, 0.02, 0.02]
xyz_mm = [0, 0, 0]
position_sigma_mm = 0
turn_sigma_deg = 0
"""
TARGET = """
[[target]]
name = "{}"
xyz_mm = [{}, {}, {}]
sigma_mm = 0
"""
RIG = TRACKER + "".join(TARGET.format(name, *(1e3 * v for v in xyz)) for name, xyz in TARGETS.items())
SIGMA_M = 2e-5


def tracked(q, ends, noise):
    """Return the text of a table: poses of each target in turn. ends (n, 4, 4); noise (n, 3) in the tracker's sigmas."""
    lines = ["kind,tracker,target,x_m,y_m,z_m," + ",".join(f"q{i}_rad" for i in range(1, q.shape[1] + 1))]
    for i, (joints, end) in enumerate(zip(q, ends, strict=True)):
        name = list(TARGETS)[i % len(TARGETS)]
        point = end[:3, :3] @ TARGETS[name] + end[:3, 3] + SIGMA_M * noise[i]
        lines.append(",".join(["position", "t", name, *(repr(float(v)) for v in (*point, *joints))]))
    return "\n".join([*lines, ""])
