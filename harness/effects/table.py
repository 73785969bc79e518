"""The effects by name. A new one is one file and one line here; a scene imports only those that it names."""

EFFECTS = {
    "air-drag": "harness.effects.air_drag:AirDrag",
    "attachments": "harness.effects.attachments:Attachments",
    "bending": "harness.effects.bending:Bending",
    "constant-force": "harness.effects.constant_force:ConstantForce",
    "contact": "harness.effects.contact:Contact",
    "dashpots": "harness.effects.dashpots:Dashpots",
    "ether-drag": "harness.effects.ether_drag:EtherDrag",
    "gas": "harness.effects.gas:Gas",
    "gravity": "harness.effects.gravity:Gravity",
    "pins": "harness.effects.pins:Pins",
    "rayleigh": "harness.effects.rayleigh:Rayleigh",
    "springs": "harness.effects.springs:Springs",
    "strain-limits": "harness.effects.strain_limits:StrainLimits",
    "wind": "harness.effects.wind:Wind",
}
