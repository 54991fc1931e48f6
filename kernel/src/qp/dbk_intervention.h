/* Size of the intervention. */
#ifndef DBK_INTERVENTION_H
#define DBK_INTERVENTION_H

#include "dbk_math.h"

/* sets out->delta, delta_rows and delta_box, and ctx->u_nom_prev */
void dbk_intervention(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, dbk_out *out);

#endif
