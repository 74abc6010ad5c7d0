"""The values of feature set `auros21`: the paper's 21, in its order (section 3.2.2)."""

MFCC_COUNT = 13
MEL_BANDS = 32  # of which the cepstra are made

_FEATURES = (
    ("energy", "of full scale squared"),
    ("zero_crossing_rate", "per step"),
    ("energy_entropy", "bit"),
    ("spectral_centroid", "of 8 kHz"),
    ("spectral_spread", "of 8 kHz"),
    ("spectral_entropy", "bit"),
    ("spectral_flux", "1"),
    ("spectral_rolloff", "of 8 kHz"),
    *((f"mfcc_{i}", "dB") for i in range(1, MFCC_COUNT + 1)),
)
FEATURE_NAMES = tuple(name for name, _ in _FEATURES)
UNITS = tuple(unit for _, unit in _FEATURES)

ENERGY = FEATURE_NAMES.index("energy")
FLUX = FEATURE_NAMES.index("spectral_flux")
CEPSTRA = slice(FEATURE_NAMES.index("mfcc_1"), len(FEATURE_NAMES))
