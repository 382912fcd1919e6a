"""Camera response from surface that photographs of different, known exposure share; needs no light and no material.

A patch c is equally bright in every view, up to gloss, so log f^-1(I_vc) = log e_v + s_c + n. Known exposures fix the
exponent of f. Unknown ones leave it open: f(x^(1 / p)) with exposures e^p and levels p s fits as well for every p, so the
exponent stays near that of sRGB and the result says so (`CalibratedResponse.gauge`). We maximise the likelihood of the
sensor values over the parameters of f with the levels s_c eliminated:

* n has Student's t distribution (4 degrees of freedom): gloss and misregistration have heavy tails. Its width is
  estimated for every block (object), so that glossy objects lose their say without a word about materials.
* The density of I brings in log dI / d log x. Without it the fit would flatten the noise by bending the curve.
* A patch of m rows spends one of them on its own level, hence the factor (m - 1) / m on its rows. This amounts to a
  level that is as likely to lie anywhere in the sensor's range.
* Rounding to 8 bits is noise of 0.29 steps; it limits dark rows.
* Saturated rows enter as what they are, e exp(s) >= x(saturation): they tie down the scale of x, which f(1) = 1 would
  otherwise leave to extrapolation.

Errors of neighbouring patches go together (a glossy table is too bright in one view as a whole). Rows of one block in
one view are one cluster; the spread of the clusters' scores gives the covariance (sandwich), the price of a parameter
(Takeuchi's criterion) and the weight of the data against the prior.
"""
