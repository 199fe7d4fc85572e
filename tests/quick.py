"""elastix parameters that register a small image in seconds."""

QUICK = """
(Registration "MultiResolutionRegistration")
(Metric "AdvancedNormalizedCorrelation")
(Optimizer "AdaptiveStochasticGradientDescent")
(Transform "RecursiveBSplineTransform")
(Interpolator "LinearInterpolator")
(ImageSampler "RandomCoordinate")
(FixedImagePyramid "FixedSmoothingImagePyramid")
(MovingImagePyramid "MovingSmoothingImagePyramid")
(FinalGridSpacingInPhysicalUnits 8.0)
(NumberOfResolutions 2)
(MaximumNumberOfIterations 80)
(NumberOfSpatialSamples 2000)
(NewSamplesEveryIteration "true")
(AutomaticParameterEstimation "true")
(ErodeMask "false")
(RequiredRatioOfValidSamples 0.05)
"""
