"""All planted errors."""

from __future__ import annotations

from tests.mutations.archive import ARCHIVE
from tests.mutations.contact import CONTACT
from tests.mutations.device import DEVICE
from tests.mutations.energies import ENERGIES
from tests.mutations.energy_balance import ENERGY_BALANCE
from tests.mutations.error_control import ERROR_CONTROL
from tests.mutations.exact_lengths import EXACT_LENGTHS
from tests.mutations.gates import GATES
from tests.mutations.grading import GRADING
from tests.mutations.measuring import MEASURING
from tests.mutations.mesh_files import MESH_FILES
from tests.mutations.page import PAGE
from tests.mutations.pictures import PICTURES
from tests.mutations.published import PUBLISHED_STUDIES
from tests.mutations.settings import SETTINGS
from tests.mutations.solving import SOLVING
from tests.mutations.steps import STEPS

TABLE = ENERGIES + CONTACT + STEPS + MEASURING + PICTURES + DEVICE + ARCHIVE + GATES + EXACT_LENGTHS + ENERGY_BALANCE
TABLE += ERROR_CONTROL + PAGE + GRADING + SETTINGS + MESH_FILES + PUBLISHED_STUDIES + SOLVING
