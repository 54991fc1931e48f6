/* Independent check of a control, and the certificate of the next state. */
#ifndef DBK_CERTIFICATE_H
#define DBK_CERTIFICATE_H

#include "dbk_math.h"

/* 1: u is finite, within the bounds, and satisfies every row to `tolerance`; 0 if any value is NaN */
int32_t dbk_check(const dbk_rows *rows, int32_t n, const dbk_real lower[DBK_MAX_DOF], const dbk_real upper[DBK_MAX_DOF],
                  const dbk_real u[DBK_MAX_DOF], dbk_real tolerance);

/* 1: at the state after one period of u, every pair in ctx->revisits has h >= 0, or an h no smaller than now */
int32_t dbk_certify(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                    const dbk_real u[DBK_MAX_DOF]);

#endif
