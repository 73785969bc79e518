"""Table of the effects by name; a scene imports only the effects that it names."""

from solvers.plugins import PluginTable

EFFECT_CLASSES = {
    "air-drag": "harness.scenes.effects.air_drag:AirDrag",
    "attachments": "harness.scenes.effects.attachments:Attachments",
    "bending": "harness.scenes.effects.bending:Bending",
    "constant-force": "harness.scenes.effects.constant_force:ConstantForce",
    "contact": "harness.scenes.effects.contact:Contact",
    "dashpots": "harness.scenes.effects.dashpots:Dashpots",
    "ether-drag": "harness.scenes.effects.ether_drag:EtherDrag",
    "gas": "harness.scenes.effects.gas:Gas",
    "gravity": "harness.scenes.effects.gravity:Gravity",
    "pins": "harness.scenes.effects.pins:Pins",
    "rayleigh": "harness.scenes.effects.rayleigh:Rayleigh",
    "self-contact": "harness.scenes.effects.self_contact:SelfContact",
    "sewing": "harness.scenes.effects.sewing:Sewing",
    "springs": "harness.scenes.effects.springs:Springs",
    "strain-limits": "harness.scenes.effects.strain_limits:StrainLimits",
    "surface-contact": "harness.scenes.effects.surface_contact:SurfaceContact",
    "wind": "harness.scenes.effects.wind:Wind",
}

EFFECT_TABLE = PluginTable("springbench.effects", EFFECT_CLASSES)
"""All effects by name."""
