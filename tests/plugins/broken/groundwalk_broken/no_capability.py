from groundwalk.training.regressor_settings import RegressorSettings
from groundwalk.training.regressors import Regressor
from groundwalk_broken.regressors import make_wrong_shape

REGRESSOR = Regressor(  # type: ignore[call-arg]
    id="no_capability",
    label="no capability",
    meaning="doesn't say whether it holds several scenes",
    colour=(0, 0, 0),
    settings=RegressorSettings,
    make=make_wrong_shape,
    gives_covariance=False,
)
