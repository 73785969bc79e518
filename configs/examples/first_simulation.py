"""A first simulation: a cloth that hangs by two corners, for one second."""

import springbench

scene = springbench.make_scene(
    mesh={"kind": "grid"},
    mass=0.5,
    time_step="1/30",
    frames=30,
    default_size=12,
    effects=[{"kind": "springs", "stretch": 300.0}, {"kind": "gravity"}, {"kind": "pins", "parts": ["top_corners"]}],
)

if __name__ == "__main__":
    simulation = springbench.Simulation(scene, "hybrid", rtol=1e-6)
    lowest = simulation.run_steps(30)[:, :, 1].min(axis=1)
    for k in range(4, 30, 5):
        print(f"after {(k + 1) / 30:.2f} s the lowest vertex is at {lowest[k]:.3f} m")
