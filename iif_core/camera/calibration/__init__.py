"""Calibration of the camera response from surface that photographs of different exposure share (Eq. C.17 to C.24).

A patch c is equally bright in every view, up to gloss, so log f^-1(I_vc) = log e_v + s_c + n. Light and materials are not
needed. Known exposures fix the exponent of f. Unknown exposures leave it open: f(x^(1 / p)) with exposures e^p and levels p s
fits equally well for every p, so the prior keeps the exponent near that of sRGB and the result says so
(`CalibratedResponse.gauge`). The likelihood of the sensor values is maximised over the parameters of f, with the levels s_c
eliminated:

* n has Student's t distribution (4 degrees of freedom), because gloss and misregistration have heavy tails. Its width is
  estimated for every block (object), so that glossy objects lose their weight without a model of their material.
* The density of I contains log dI / d log x. Without it, the fit would reduce the noise by bending the curve.
* The level of a patch of m rows uses up one of them, hence the factor (m - 1) / m on its rows.
* Rounding to 8 bits is noise of 0.29 steps, which limits dark rows.
* A saturated row is a bound, e exp(s) >= x(saturation). Bounds determine the scale of x, which f(1) = 1 would otherwise leave
  to extrapolation.

The errors of neighbouring patches are correlated. The rows of one block in one view form a cluster; the spread of the scores
of the clusters gives the covariance (sandwich, Eq. C.23), the price of a parameter (Takeuchi's criterion, Eq. C.22) and the
weight of the data against the prior.
"""
