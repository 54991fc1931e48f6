/* Trust region: the part of the control bounds in which the solution is searched first.
 *
 * Rows that no control within the trust region can violate are omitted; these are usually most rows. If the solution of
 * the reduced problem is within the trust region, it is the solution of the full problem: it satisfies the omitted
 * rows, and the removal of rows cannot move the optimum farther from u_nom (the cost is strictly convex, so the optimum
 * is unique). The trust region is centred at the previous control if rows were active in the previous step, because
 * they are usually active again, and at the nominal control otherwise. If the solution is outside, the next trust
 * region is centred at it. After DBK_TRUST_TRIES attempts the full control bounds are used.
 */
#include "model/dbk_trust_region.h"

/* joints with narrow control bounds (at most 4 radii) keep their full range */
void dbk_trust_region_around(const dbk_model *model, dbk_ctx *ctx, const dbk_real expected[DBK_MAX_DOF]) {
  ctx->trust_active = 0;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real low = ctx->lower[k], high = ctx->upper[k], radius = DBK_TRUST_RADIUS * model->v_max[k];
    const dbk_real centre = dbk_clamp(expected[k], low, high);
    const int32_t wide = high - low > (dbk_real)4 * radius;
    ctx->trust_lower[k] = wide ? dbk_max(low, centre - radius) : low;
    ctx->trust_upper[k] = wide ? dbk_min(high, centre + radius) : high;
    ctx->trust_active |= wide;
  }
}

void dbk_trust_region_full(const dbk_model *model, dbk_ctx *ctx) {
  for (int32_t k = 0; k < model->n; ++k) {
    ctx->trust_lower[k] = ctx->lower[k];
    ctx->trust_upper[k] = ctx->upper[k];
  }
  ctx->trust_active = 0;
}

int32_t dbk_trust_region_contains(const dbk_model *model, const dbk_ctx *ctx, const dbk_real u[DBK_MAX_DOF]) {
  int32_t inside = 1;
  for (int32_t k = 0; k < model->n; ++k) { inside &= u[k] >= ctx->trust_lower[k] && u[k] <= ctx->trust_upper[k]; }
  return inside;
}
