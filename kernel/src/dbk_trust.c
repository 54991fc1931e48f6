/* Where the answer is looked for first: a part of the box of admissible controls, around where it is expected.
 *
 * Rows are left out that no control of this trust box can violate, as a rule most of them. The answer of the others is
 * that of all where it lies in the trust box: it meets the rows left out, and fewer rows cannot make it farther from
 * u_nom (the cost is strictly convex, the optimum unique). It is expected at the last control where rows bound that one,
 * which they do again a moment later, and else at the nominal one. Where it turns out to lie elsewhere, that is where one
 * looks next; after a few times, the whole box is taken.
 */
#include "dbk_step.h"

/* around the control that is expected; joints whose box is hardly wider keep the whole of it */
void dbk_trust_near(const dbk_model *model, dbk_ctx *ctx, const dbk_real expected[DBK_MAX_DOF]) {
  ctx->trusted = 0;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real low = ctx->lower[k], high = ctx->upper[k], reach = DBK_TRUST * model->v_max[k];
    const dbk_real middle = dbk_clamp(expected[k], low, high);
    const int32_t wide = high - low > (dbk_real)4 * reach;
    ctx->trust_lower[k] = wide ? dbk_max(low, middle - reach) : low;
    ctx->trust_upper[k] = wide ? dbk_min(high, middle + reach) : high;
    ctx->trusted |= wide;
  }
}

void dbk_trust_all(const dbk_model *model, dbk_ctx *ctx) {
  for (int32_t k = 0; k < model->n; ++k) {
    ctx->trust_lower[k] = ctx->lower[k];
    ctx->trust_upper[k] = ctx->upper[k];
  }
  ctx->trusted = 0;
}

int32_t dbk_in_trust(const dbk_model *model, const dbk_ctx *ctx, const dbk_real u[DBK_MAX_DOF]) {
  int32_t inside = 1;
  for (int32_t k = 0; k < model->n; ++k) { inside &= u[k] >= ctx->trust_lower[k] && u[k] <= ctx->trust_upper[k]; }
  return inside;
}
