/* Readings of `eitskin live MODEL --udp 5005`, printed as they come; docs/robot.md has the records.
 *
 *     cc -std=c11 -o listen listen.c && ./listen 5005
 *
 * A record is one line of JSON. Quotes within its texts are escaped, so that "key": occurs only
 * where a key is, and a few values can be read without a JSON library. */
#define _POSIX_C_SOURCE 200112L
#include <arpa/inet.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>

/* Text after "key": in the record; NULL where it is missing or null. */
static const char *value(const char *record, const char *key)
{
    char quoted[40];
    snprintf(quoted, sizeof quoted, "\"%s\": ", key);
    const char *found = strstr(record, quoted);
    if (found == NULL || strncmp(found + strlen(quoted), "null", 4) == 0)
        return NULL;
    return found + strlen(quoted);
}

/* Number after "key": in the record; NAN where it is unknown. */
static double number(const char *record, const char *key)
{
    const char *text = value(record, key);
    return text == NULL ? NAN : strtod(text, NULL);
}

static void show(const char *record)
{
    const char *kind = value(record, "kind"), *state = value(record, "state");
    if (kind == NULL || number(record, "version") != 1.0)
        return; /* another program's datagram, or a newer eitskin's */
    if (strncmp(kind, "\"silence\"", 9) == 0) {
        printf("nothing for %.0f s\n", number(record, "seconds"));
        return;
    }
    printf("%.0f: %.*s, %+.1f deg", number(record, "number"),
           state == NULL ? 7 : (int)strcspn(state + 1, "\""), state == NULL ? "unknown" : state + 1,
           number(record, "bend_angle_deg"));
    const char *touches = value(record, "touches");
    const char *end = touches == NULL ? NULL : strchr(touches, ']');
    while (end != NULL && (touches = strchr(touches, '{')) != NULL && touches < end) {
        printf(", touch at (%.1f, %.1f) mm", 1e3 * number(touches, "x"), 1e3 * number(touches, "y"));
        printf(" with %.1f N", number(touches, "force"));
        touches++;
    }
    printf("\n");
}

int main(int count, char **arguments)
{
    struct sockaddr_in address = {.sin_family = AF_INET};
    struct timeval patience = {.tv_sec = 3};
    static char record[65536];
    int left = count > 2 ? atoi(arguments[2]) : -1; /* records until it ends; -1 for no end */
    int in = socket(AF_INET, SOCK_DGRAM, 0);
    address.sin_port = htons((unsigned short)(count > 1 ? atoi(arguments[1]) : 5005));
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    setsockopt(in, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    socklen_t size = sizeof address;
    if (bind(in, (struct sockaddr *)&address, size) != 0 ||
        getsockname(in, (struct sockaddr *)&address, &size) != 0) {
        perror("cannot listen");
        return 1;
    }
    printf("listening at %u\n", ntohs(address.sin_port));
    for (fflush(stdout); left != 0;) {
        ssize_t length = recv(in, record, sizeof record - 1, 0);
        record[length > 0 ? length : 0] = '\0';
        if (length > 0) {
            show(record);
            left -= left > 0;
        } else /* a second without a frame is told: eitskin itself has ended */
            printf("no records for 3 s\n");
        fflush(stdout);
    }
    return 0;
}
