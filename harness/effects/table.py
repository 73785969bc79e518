"""The effects by name. A new one is one file and one line here; a scene imports only those that it names."""

EFFECTS = {
    "constant-force": "harness.effects.constant_force:ConstantForce",
    "ether-drag": "harness.effects.ether_drag:EtherDrag",
    "gravity": "harness.effects.gravity:Gravity",
    "pins": "harness.effects.pins:Pins",
    "springs": "harness.effects.springs:Springs",
    "wind": "harness.effects.wind:Wind",
}
