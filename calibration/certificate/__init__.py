"""The certificate of an acceptance: what was measured, how surely, against which limits; as JSON and one HTML page."""

from calibration.certificate.document import Certificate, CertificateError

__all__ = ["Certificate", "CertificateError"]
