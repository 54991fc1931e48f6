/* Trust region: the part of the control bounds in which the solution is searched first. */
#ifndef DBK_TRUST_REGION_H
#define DBK_TRUST_REGION_H

#include "dbk_math.h"

/* sets the trust region around an expected solution */
void dbk_trust_region_around(const dbk_model *model, dbk_ctx *ctx, const dbk_real expected[DBK_MAX_DOF]);

/* sets the trust region to the full control bounds */
void dbk_trust_region_full(const dbk_model *model, dbk_ctx *ctx);

int32_t dbk_trust_region_contains(const dbk_model *model, const dbk_ctx *ctx, const dbk_real u[DBK_MAX_DOF]);

#endif
