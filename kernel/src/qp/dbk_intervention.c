/* Size of the intervention (paper 4.4): delta = |u - u_nom|_W with W = diag(1/v_max^2)/n, saturated at 2. */
#include "qp/dbk_intervention.h"

static dbk_real distance_w(const dbk_model *model, const dbk_real *a, const dbk_real *b) {
  dbk_real square = (dbk_real)0;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real e = (a[k] - b[k]) / model->v_max[k];
    square += e * e;
  }
  return dbk_sqrt(square / (dbk_real)model->n);
}

/* delta_box is the distance of u_nom from the velocity and acceleration bounds around the previous nominal control: no
 * robot could have followed this part of the nominal control. delta_rows is the rest, which the rows cause. */
void dbk_intervention(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, dbk_out *out) {
  dbk_real clipped[DBK_MAX_DOF];
  const int32_t finite = dbk_all_finite(in->u_nom, model->n);
  if (!finite) {
    out->delta = out->delta_rows = (dbk_real)2;
    out->delta_box = (dbk_real)0;
    return;
  }
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real step = model->a_max[k] * model->period, last = ctx->u_nom_prev[k];
    const dbk_real within = dbk_clamp(in->u_nom[k], last - step, last + step);
    clipped[k] = dbk_clamp(within, -model->v_max[k], model->v_max[k]);
    ctx->u_nom_prev[k] = in->u_nom[k];
  }
  const dbk_real delta = distance_w(model, out->u, in->u_nom), box = distance_w(model, clipped, in->u_nom);
  out->delta = delta <= (dbk_real)2 ? delta : (dbk_real)2;
  out->delta_box = dbk_min(out->delta, box <= (dbk_real)2 ? box : (dbk_real)2);
  out->delta_rows = out->delta - out->delta_box;
}
