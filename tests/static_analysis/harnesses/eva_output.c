/* Frama-C Eva: the last function of every step gives a finite control within the velocity limits, for every bit pattern
 * of the control that the step computed, of the state and of the nominal control. */
#include "dbk_step.c"

#include "arbitrary.h"

int main(void) {
  static dbk_model model;
  static dbk_ctx ctx;
  static dbk_in in;
  dbk_out out;
  dbk_real u[DBK_MAX_DOF];
  model.n = DBK_MAX_DOF;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { model.v_max[k] = (dbk_real)2.5; }
  ctx.solution.n_active = ctx.rows.count = 0;
  while (arbitrary_word) {
    fill_arbitrary(u, DBK_MAX_DOF);
    fill_arbitrary(in.u_nom, DBK_MAX_DOF);
    fill_arbitrary(ctx.u_prev, DBK_MAX_DOF);
    (void)finish(&model, &ctx, &in, DBK_MODIFIED, (int32_t)(arbitrary_word & 0x7FFFu), (int32_t)(arbitrary_word & 1u), u, &out);
    for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
      /*@ assert \is_finite(out.u[k]) && -2.5 <= out.u[k] <= 2.5; */
    }
  }
  return 0;
}
