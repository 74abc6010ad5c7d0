"""A way to learn from each set: a support vector machine on means and deviations of a second."""

from hearthlog.analyzer.training.window_methods import SvmMethod
from hearthlog.models.classifiers.rbf_machines import SVM_RBF
from hearthlog.models.features import FeatureSet
from hearthlog_feature_sets.auditory_image import SAI
from hearthlog_feature_sets.logmel import LOGMEL
from hearthlog_feature_sets.plp import PLP
from hearthlog_feature_sets.rasta import RASTA


def _svm(features: FeatureSet) -> SvmMethod:
    name = features.name
    return SvmMethod(name, name, "statistics", SVM_RBF.name, copies=0, cost=4.0, gamma=0.5)


LOGMEL_SVM = _svm(LOGMEL)
PLP_SVM = _svm(PLP)
RASTA_SVM = _svm(RASTA)
SAI_SVM = _svm(SAI)
