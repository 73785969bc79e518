"""Table of the effects by name; a scene imports only the effects that it names."""

from springbench.solvers.plugins.plugin_discovery import PluginTable

EFFECT_CLASSES = {
    "air-drag": "springbench.harness.scenes.effects.air_drag_effect:AirDragEffect",
    "attachments": "springbench.harness.scenes.effects.attachments_effect:AttachmentsEffect",
    "bending": "springbench.harness.scenes.effects.bending_effect:BendingEffect",
    "constant-force": "springbench.harness.scenes.effects.constant_force_effect:ConstantForceEffect",
    "contact": "springbench.harness.scenes.effects.contact_effect:ContactEffect",
    "dashpots": "springbench.harness.scenes.effects.dashpots_effect:DashpotsEffect",
    "ether-drag": "springbench.harness.scenes.effects.ether_drag_effect:EtherDragEffect",
    "gas": "springbench.harness.scenes.effects.gas_effect:GasEffect",
    "gravity": "springbench.harness.scenes.effects.gravity_effect:GravityEffect",
    "pins": "springbench.harness.scenes.effects.pins_effect:PinsEffect",
    "rayleigh": "springbench.harness.scenes.effects.rayleigh_effect:RayleighEffect",
    "self-contact": "springbench.harness.scenes.effects.self_contact_effect:SelfContactEffect",
    "sewing": "springbench.harness.scenes.effects.sewing_effect:SewingEffect",
    "springs": "springbench.harness.scenes.effects.springs_effect:SpringsEffect",
    "strain-limits": "springbench.harness.scenes.effects.strain_limits_effect:StrainLimitsEffect",
    "surface-contact": "springbench.harness.scenes.effects.surface_contact_effect:SurfaceContactEffect",
    "wind": "springbench.harness.scenes.effects.wind_effect:WindEffect",
}

EFFECT_TABLE = PluginTable("springbench.effects", EFFECT_CLASSES)
"""All effects by name."""
