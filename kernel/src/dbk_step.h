/* The parts of one step that are no business of others. */
#ifndef DBK_STEP_H
#define DBK_STEP_H

#include "dbk_math.h"

/* dbk_trust.c */
void dbk_trust_near(const dbk_model *model, dbk_ctx *ctx, const dbk_real expected[DBK_MAX_DOF]);
void dbk_trust_all(const dbk_model *model, dbk_ctx *ctx);
int32_t dbk_in_trust(const dbk_model *model, const dbk_ctx *ctx, const dbk_real u[DBK_MAX_DOF]);

/* dbk_active.c: the warm start in this step's numbering; the other way round */
int32_t dbk_recall(const dbk_model *model, const dbk_ctx *ctx, int32_t ids[DBK_QP_DIM]);
void dbk_remember_active(const dbk_model *model, dbk_ctx *ctx, dbk_out *out);

/* dbk_measure.c */
void dbk_measure(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, dbk_out *out);

#endif
